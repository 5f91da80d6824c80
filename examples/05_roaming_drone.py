"""A drone streams to its station while the network under it changes (scenario A of chapter 8).

The drone knows two routers. The first one goes down in mid-flight, as when a drone leaves the reach of a Wi-Fi network; the
drone carries on through the second. Telemetry is reliable: what was in the air is sent again, in order. The camera is lossy:
the station wants the newest image, not all of them. Run with `python examples/05_roaming_drone.py`.
"""

import os
import tempfile
import time
from itertools import pairwise
from pathlib import Path

from tutelage.sgc.local import LocalFleet
from tutelage.sgc.messages import Message

POLICY = """
version = 1

[topics.telemetry]
node = "drone-1"
interface = "/odometry"
type = "nav_msgs/msg/Odometry"
owner = "drone-1"
publish = ["drone-1"]
subscribe = ["station"]

[topics.camera]
node = "drone-1"
interface = "/camera"
type = "sensor_msgs/msg/CompressedImage"
owner = "drone-1"
publish = ["drone-1"]
subscribe = ["station"]
delivery = "lossy"
authenticity = "chain"
"""

positions: list[int] = []
arrivals: list[float] = []
images: list[int] = []


def on_telemetry(message: Message) -> None:
    positions.append(int(message.payload))
    arrivals.append(time.monotonic())


with (
    tempfile.TemporaryDirectory() as folder,
    LocalFleet(Path(folder), POLICY, ["drone-1", "station"], routers=2, protocol="quic") as fleet,
    fleet.open("station") as station,
    fleet.open("drone-1") as drone,
):
    station.subscribe("telemetry", on_telemetry)
    station.subscribe("camera", lambda image: images.append(len(image.payload)))
    telemetry, camera = drone.publisher("telemetry"), drone.publisher("camera")
    print(f"on the network the camera is called {drone.access.entry('camera').name.hex()}")

    for step in range(300):
        telemetry.send(b"%d" % step)
        if step % 3 == 0:
            camera.send(os.urandom(30_000))
        if step == 100:
            fleet.routers[0].close()
            print("out of reach of the first router")
        time.sleep(0.01)

    until = time.monotonic() + 10
    while len(positions) < 300 and time.monotonic() < until:
        time.sleep(0.01)
    gap = max(b - a for a, b in pairwise(arrivals))
    print(
        f"{len(positions)} of 300 positions arrived, in order: {positions == sorted(positions)}; longest silence {gap:.2f} s"
    )
    print(f"{len(images)} of 100 images arrived")
    assert positions == list(range(300))
