"""Ten robots at three sites, each behind address translation; one server, two people, and a policy that learns from them.

The networks are inside this machine: three sites and the server's office have the same private addresses and dial out to a
router in the open. Robots, router and server are processes of their own (`tutelage robot`, `tutelage router`,
`tutelage serve`); the people are programs that log in and work over the page's own interface. Nothing leaves this machine.

Run with `python examples/08_ten_robots_behind_nat.py` (Linux, as root, with iproute2 and nftables). It takes two minutes.
"""

import asyncio
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

from tutelage.console.scripted import ScriptedOperator, after
from tutelage.remote.setup import new_fleet

SITES = ("berkeley", "pittsburgh", "tokyo")
PEOPLE, PASSWORD = ("ann", "bob"), "ten robots, two people"
ROUTER, PORT, SECONDS, HZ = "10.91.0.1", 7447, 60, 20
TUTELAGE = [sys.executable, "-c", "from tutelage.cli import main; main()"]
NAT = "add table ip t; add chain ip t out { type nat hook postrouting priority 100 ; }; "
NAT += "add rule ip t out oifname wan masquerade"


class Networks:
    """A router in the open, and sites of one machine each behind a translating gateway. Needs root; ends with the block."""

    def __init__(self, sites: tuple[str, ...]) -> None:
        self.sites, self.prefix, self.made = sites, f"ten{os.getpid()}", []

    def inside(self, place: str) -> list[str]:
        """The words before a command that is to run at a place: "router" or a site."""
        return ["ip", "netns", "exec", f"{self.prefix}-{place}"]

    def __enter__(self) -> "Networks":
        for place in ("switch", "router", *self.sites, *(f"nat-{site}" for site in self.sites)):
            run("ip", "netns", "add", f"{self.prefix}-{place}")
            self.made.append(place)
            self.at(place, "ip link set lo up")
        self.at("switch", "ip link add br0 type bridge")
        self.at("switch", "ip link set br0 up")
        self.plug("router", f"{ROUTER}/16")
        for k, site in enumerate(self.sites, 1):
            self.plug(f"nat-{site}", f"10.91.{k}.1/16")
            self.at(f"nat-{site}", "echo 1 > /proc/sys/net/ipv4/ip_forward")
            self.at(f"nat-{site}", f"nft '{NAT}'")
            self.at(f"nat-{site}", f"ip link add lan type veth peer name eth0 netns {self.prefix}-{site}")
            self.at(f"nat-{site}", "ip addr add 192.168.1.1/24 dev lan; ip link set lan up")
            self.at(site, "ip addr add 192.168.1.2/24 dev eth0; ip link set eth0 up; ip route add default via 192.168.1.1")
        return self

    def __exit__(self, *error: object) -> None:
        for place in self.made:
            subprocess.run(["ip", "netns", "del", f"{self.prefix}-{place}"], capture_output=True, check=False)

    def at(self, place: str, line: str) -> None:
        run(*self.inside(place), "sh", "-c", line)

    def plug(self, place: str, address: str) -> None:
        self.at("switch", f"ip link add to-{place[:11]} type veth peer name wan netns {self.prefix}-{place}")
        self.at("switch", f"ip link set to-{place[:11]} master br0; ip link set to-{place[:11]} up")
        self.at(place, f"ip addr add {address} dev wan; ip link set wan up")


def run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True, timeout=120)


def why_not() -> str:
    """Why this machine cannot do it; "" if it can."""
    if sys.platform != "linux" or os.geteuid() != 0:
        return "networks inside a machine need Linux, and root"
    missing = [tool for tool in ("ip", "nft") if shutil.which(tool) is None]
    if missing:
        return f"not installed: {', '.join(missing)} (Debian: iproute2, nftables)"
    try:
        with Networks(()):
            return ""
    except subprocess.CalledProcessError as error:
        return f"not permitted here: {error.stderr.decode().strip()}"


class Programs:
    """Processes that end with the block; what they say goes to files."""

    def __init__(self, folder: Path, networks: Networks) -> None:
        self.folder, self.networks, self.running = folder, networks, {}

    def start(self, name: str, place: str, *words: object) -> None:
        with (self.folder / f"{name}.log").open("wb") as log:
            command = [*self.networks.inside(place), *TUTELAGE, *map(str, words)]
            environment = {**os.environ, "OMP_NUM_THREADS": "1"}
            self.running[name] = subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=environment)

    def wait_for(self, name: str, text: str, seconds: float) -> None:
        until = time.monotonic() + seconds
        while text not in (said := (self.folder / f"{name}.log").read_text()):
            if self.running[name].poll() is not None or time.monotonic() > until:
                raise SystemExit(f"{name} does not get ready:\n{said}")
            time.sleep(0.1)

    def __enter__(self) -> "Programs":
        return self

    def __exit__(self, *error: object) -> None:
        for program in self.running.values():
            program.send_signal(signal.SIGTERM)
        for program in self.running.values():
            try:
                program.wait(10)
            except subprocess.TimeoutExpired:
                program.kill()
                program.wait()


async def people_at_work(seconds: float) -> list[dict]:
    """Two people at the server's office; returns the rows of the metrics that they saw."""
    people = [ScriptedOperator("http://127.0.0.1:8800", name, PASSWORD, rule=after(3 * HZ)) for name in PEOPLE]
    tallies = await asyncio.gather(*(person.run(seconds) for person in people))
    for name, tally in zip(PEOPLE, tallies, strict=True):
        print(f"{name}: {tally.interventions} interventions, {tally.commands} commands, leases ended by {tally.ends}")
    return people[0].rows


def main() -> None:
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        networks = stack.enter_context(Networks((*SITES, "office")))
        programs = stack.enter_context(Programs(folder, networks))
        fleet = new_fleet(folder / "fleet", 10, connect=f"tls/{ROUTER}:{PORT}")
        (folder / "password").write_text(PASSWORD + "\n")
        served = folder / "served"
        for name in PEOPLE:
            run(*TUTELAGE, "accounts", "add", name, "--out", str(served), "--password-file", str(folder / "password"))

        beginner = folder / "beginner"  # a policy that has seen fifty demonstrations, not enough to get anywhere
        few = ["--robots", "2", "--humans", "1", "--steps", "1", "--priority", "U.C.", "--offline-pairs", "50"]
        run(*TUTELAGE, "run", "Navigation", *few, "--out", str(beginner))

        programs.start("router", "router", "router", fleet.router, "--listen", f"tls/0.0.0.0:{PORT}")
        for k, home in enumerate(fleet.robots):
            words = ("robot", home, "--env", "Navigation", "--hz", HZ, "--seed", k)
            programs.start(home.name, SITES[k % len(SITES)], *words)
        programs.start(
            "server", "office", "serve", "--fleet", f"net:{fleet.server}", "--humans", len(PEOPLE), "--hz", HZ,
            "--priority", "U.C.", "--policy", beginner, "--out", served,
        )  # fmt: skip
        programs.wait_for("server", "http://127.0.0.1:8800", 120)
        print(f"10 robots at {len(SITES)} sites, a server, {len(PEOPLE)} people; {SECONDS} seconds of work ...", flush=True)

        # The people sit in the office: their process enters its network.
        work = [sys.executable, __file__, "--people", str(folder / "rows.json")]
        subprocess.run([*networks.inside("office"), *work], check=True, timeout=SECONDS + 60)
        rows = json.loads((folder / "rows.json").read_text())
        report(rows)


def report(rows: list[dict]) -> None:
    """How it went in each quarter of the time."""
    told = {"successes": "goals reached", "hard_resets": "hard resets", "human_steps": "timesteps of help"}
    for k in range(4):
        begin, end = rows[k * (len(rows) - 1) // 4], rows[(k + 1) * (len(rows) - 1) // 4]
        what = ", ".join(f"{end[name] - begin[name]:4.0f} {words}" for name, words in told.items())
        print(f"{end['time'] - begin['time']:3.0f} s: {what}")
    print(f"the policy is at version {rows[-1]['policy_version']}: so often were weights swapped that the people had taught")
    assert rows[-1]["policy_version"] > 0


if __name__ == "__main__":
    if sys.argv[1:2] == ["--people"]:
        Path(sys.argv[2]).write_text(json.dumps(asyncio.run(people_at_work(SECONDS))))
    elif reason := why_not():
        print(f"skipped: {reason}")
    else:
        main()
