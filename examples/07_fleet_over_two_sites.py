"""Four arms at two sites, one policy on a server elsewhere, and a person who helps from a third place (scenario C).

Each site has a router of its own; the routers are joined. Every arm sends what it sees and gets its next action; the arm
whose policy is least sure is handed to the person, who drives it over a session: nobody else could have sent those commands.
The arms here are points that should reach a goal. Run with `python examples/07_fleet_over_two_sites.py`.
"""

import tempfile
import threading
import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np

from tutelage.seeding import stream
from tutelage.sgc.local import LocalFleet
from tutelage.sgc.node import Node
from tutelage.sgc.transport.config import Endpoint, NetworkConfig

ARMS = ("berkeley-1", "berkeley-2", "pittsburgh-1", "pittsburgh-2")
STEPS, DT = 40, 0.2

POLICY = "version = 1\n" + "".join(
    f"""
[topics.state-{arm}]
node = "{arm}"
interface = "/state"
type = "std_msgs/msg/Float32MultiArray"
owner = "{arm}"
publish = ["{arm}"]
subscribe = ["server", "operator"]

[topics.action-{arm}]               # commands: too old is as bad as forged
node = "{arm}"
interface = "/action"
type = "std_msgs/msg/Float32MultiArray"
owner = "{arm}"
publish = ["server", "operator"]
subscribe = ["{arm}"]
authenticity = "session"
max_age = 2.0
"""
    for arm in ARMS
)


class Arm:
    """A point on a table that moves as it is told and says where it is."""

    def __init__(self, node: Node, seed: int) -> None:
        self.position = stream(seed, node.name).uniform(-1, 1, 2).astype(np.float32)
        self.publisher = node.publisher(f"state-{node.name}")
        node.subscribe(f"action-{node.name}", lambda command: self.move(np.frombuffer(command.payload, np.float32)))

    def move(self, action: np.ndarray) -> None:
        self.position = self.position + DT * action
        self.tell()

    def tell(self) -> None:
        self.publisher.send(self.position.tobytes())


class Mailbox:
    """The newest state of each arm, as a node far away sees it."""

    def __init__(self, node: Node) -> None:
        self.states: dict[str, np.ndarray] = {}
        self.news = threading.Condition()
        for arm in ARMS:
            node.subscribe(f"state-{arm}", lambda message: self.put(message.sender, message.payload))

    def put(self, arm: str, payload: bytes) -> None:
        with self.news:
            self.states[arm] = np.frombuffer(payload, np.float32)
            self.news.notify_all()

    def all_after(self, before: dict[str, np.ndarray], timeout: float = 10.0) -> dict[str, np.ndarray]:
        """Wait until every arm has moved on."""
        with self.news:
            fresh = self.news.wait_for(
                lambda: len(self.states) == len(ARMS) and all(self.states[a] is not before.get(a) for a in ARMS), timeout
            )
            assert fresh, "an arm fell silent"
            return dict(self.states)


with ExitStack() as stack:
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
    fleet = stack.enter_context(LocalFleet(folder, POLICY, [*ARMS, "server", "operator"], routers=2))
    berkeley, pittsburgh = map(Endpoint.parse, fleet.addresses)
    for name in ("pittsburgh-1", "pittsburgh-2", "server"):
        NetworkConfig((pittsburgh, berkeley)).save(fleet.homes[name].path)  # its own site's router first
    server, operator = (stack.enter_context(fleet.open(name)) for name in ("server", "operator"))
    mailbox = Mailbox(server)
    arms = [Arm(stack.enter_context(fleet.open(name)), seed=0) for name in ARMS]
    drives = {
        who: {arm: node.publisher(f"action-{arm}") for arm in ARMS}
        for who, node in (("policy", server), ("human", operator))
    }
    time.sleep(1.0)  # sessions are opened
    for arm in arms:
        arm.tell()
    states, helped, took = mailbox.all_after({}), 0, []
    for _ in range(STEPS):
        asks = max(ARMS, key=lambda arm: float(np.linalg.norm(states[arm])))  # the farthest from its goal is least sure
        start = time.perf_counter()
        for arm in ARMS:
            by_hand = arm == asks and np.linalg.norm(states[arm]) > 0.3
            gain = 1.0 if by_hand else 0.25  # the person knows better than the policy
            drives["human" if by_hand else "policy"][arm].send((-gain * states[arm]).astype(np.float32).tobytes())
            helped += by_hand
        states = mailbox.all_after(states)
        took.append(time.perf_counter() - start)
    left = max(float(np.linalg.norm(arm.position)) for arm in arms)
    print(f"{STEPS} steps of 4 arms at 2 sites, {helped} of them by hand; the farthest arm ends {left:.3f} from its goal")
    print(f"communication: {1000 * float(np.median(took)):.1f} ms a step for all four arms, there and back")
    assert left < 0.2
