"""Two companies share one topic and nothing else (scenario B of chapter 8).

A warehouse lets trucks of a carrier dock. Both have fleets of their own, with authorities, routers and topics of which the
other knows nothing. For the handoff the warehouse gives the carrier's truck a guest's home in its fleet, whose policy names
it in one topic and one service. Run with `python examples/06_two_companies.py`.
"""

import tempfile
import threading
from pathlib import Path

from tutelage.sgc.errors import NotAllowed
from tutelage.sgc.local import LocalFleet

WAREHOUSE = """
version = 1

[topics.dock]                       # shared: which door is free
node = "crane"
interface = "/dock"
type = "std_msgs/msg/String"
owner = "crane"
publish = ["crane"]
subscribe = ["carrier-truck-7", "office"]

[topics.handoff]                    # shared: a truck asks for its goods
kind = "service"
node = "crane"
interface = "/handoff"
type = "warehouse_msgs/srv/Handoff"
owner = "crane"
serve = ["crane"]
request = ["carrier-truck-7"]

[topics.inventory]                  # nobody else's business
node = "office"
interface = "/inventory"
type = "std_msgs/msg/String"
owner = "office"
publish = ["office"]
subscribe = ["crane"]
"""

CARRIER = """
version = 1

[topics.route]
node = "truck-7"
interface = "/route"
type = "nav_msgs/msg/Path"
owner = "truck-7"
publish = ["truck-7"]
subscribe = ["dispatcher"]
"""

with (
    tempfile.TemporaryDirectory() as folder,
    LocalFleet(Path(folder, "warehouse"), WAREHOUSE, ["crane", "office", "carrier-truck-7"], name="warehouse") as warehouse,
    LocalFleet(Path(folder, "carrier"), CARRIER, ["truck-7", "dispatcher"], name="carrier") as carrier,
    warehouse.open("crane") as crane,
    warehouse.open("carrier-truck-7") as guest,  # the truck's home as a guest of the warehouse ...
    carrier.open("truck-7") as truck,  # ... and the one in its own fleet
    carrier.open("dispatcher") as dispatcher,
    crane.serve("handoff", lambda order: b"pallet for order " + order.payload),
):
    heard, planned = threading.Event(), threading.Event()
    guest.subscribe("dock", lambda door: (print("the truck hears:", door.payload.decode()), heard.set()))
    dispatcher.subscribe("route", lambda route: planned.set())

    crane.publisher("dock").send(b"door 4 is free")
    assert heard.wait(10)
    print("the truck gets:", guest.request("handoff", b"1138", timeout=10).decode())

    truck.publisher("route").send(b"door 4, then Oakland")
    assert planned.wait(10)

    print("topics of the warehouse that the truck knows:", ", ".join(sorted(guest.access.topics)))
    for attempt in (lambda: guest.subscribe("inventory"), lambda: guest.publisher("dock")):
        try:
            attempt()
        except NotAllowed as error:
            print("refused:", error)
    print("present, as the truck sees it:", ", ".join(peer.name for peer in guest.peers()))
