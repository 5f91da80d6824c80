"""`python -m benchmarks.connectivity.relay ONE OTHER DELAY LOSS`: a wide-area network between two network namespaces.

A network device of layer 3 in each (TUN); a packet that goes into one comes out of the other DELAY seconds later, or never,
with probability LOSS. So TCP, QUIC and everything else lose and repeat real packets. Needs root.
"""

from __future__ import annotations

import contextlib
import ctypes
import fcntl
import os
import select
import struct
import subprocess
import sys
import time
from collections import deque

from tutelage.seeding import stream

DEVICE = "wan"
ADDRESSES = "10.91.0.1", "10.91.0.2"
_CLONE_NEWNET = 0x40000000
_TUNSETIFF, _TUN_NO_PI = 0x400454CA, 0x1001


def device(namespace: str, address: str) -> int:
    """A device in a namespace; its file descriptor."""
    handle = os.open(f"/run/netns/{namespace}", os.O_RDONLY)
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.setns(handle, _CLONE_NEWNET):
        raise OSError(ctypes.get_errno(), f"cannot enter {namespace}")
    os.close(handle)
    tun = os.open("/dev/net/tun", os.O_RDWR | os.O_NONBLOCK)
    fcntl.ioctl(tun, _TUNSETIFF, struct.pack("16sH14x", DEVICE.encode(), _TUN_NO_PI))
    for words in (f"addr add {address}/30 dev {DEVICE}", f"link set {DEVICE} txqueuelen 10000 up"):
        subprocess.run(["ip", *words.split()], check=True)
    return tun


def carry(one: int, other: int, delay: float, loss: float) -> None:
    """Until it is killed."""
    ways = {one: (other, deque[tuple[float, bytes]]()), other: (one, deque[tuple[float, bytes]]())}
    chance = stream(0, "loss").random
    while True:
        now = time.monotonic()
        for out, waiting in ways.values():
            while waiting and waiting[0][0] <= now:
                with contextlib.suppress(OSError):  # the other side takes nothing: lost, as in any network
                    os.write(out, waiting.popleft()[1])
        due = min((waiting[0][0] for _, waiting in ways.values() if waiting), default=now + 1.0)
        readable, _, _ = select.select(list(ways), [], [], max(0.0, due - time.monotonic()))
        for tun in readable:
            waiting = ways[tun][1]
            try:
                while True:
                    packet = os.read(tun, 65_536)
                    if chance() >= loss:
                        waiting.append((time.monotonic() + delay, packet))
            except BlockingIOError:
                continue


def main() -> None:
    """Entry point."""
    one, other, delay, loss = sys.argv[1:]
    devices = [device(name, address) for name, address in zip((one, other), ADDRESSES, strict=True)]
    print("up", flush=True)
    carry(*devices, float(delay), float(loss))


if __name__ == "__main__":
    main()
