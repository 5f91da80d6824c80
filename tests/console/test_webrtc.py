"""Pictures by WebRTC, between two programs on this machine."""

from __future__ import annotations

import asyncio
import contextlib
from typing import Any

import httpx
import pytest
from browsing import chromium
from consoles import PASSWORD, Running
from hypothesis import given
from hypothesis import strategies as st

aiortc = pytest.importorskip("aiortc")

from tutelage.console.webrtc import believed  # noqa: E402


async def watch(running: Running, robot: int, frames: int) -> list[Any]:
    """So many pictures, as a browser gets them."""
    peer = aiortc.RTCPeerConnection(aiortc.RTCConfiguration(iceServers=[]))
    peer.addTransceiver("video", direction="recvonly")
    arrived: asyncio.Future[Any] = asyncio.get_running_loop().create_future()
    peer.on("track", lambda track: arrived.set_result(track))
    try:
        await peer.setLocalDescription(await peer.createOffer())
        with contextlib.closing(await asyncio.to_thread(running.client, "viewer")) as client:
            offer = {"sdp": peer.localDescription.sdp, "type": "offer", "robot": robot, "fps": 20}
            answer = await asyncio.to_thread(lambda: client.post("/api/webrtc", json=offer))
        assert answer.status_code == 200, answer.text
        content = answer.json()
        assert content["iceServers"] == []
        addresses = {line.split()[4] for line in content["sdp"].splitlines() if line.startswith("a=candidate")}
        assert addresses == {"127.0.0.1"}
        await peer.setRemoteDescription(aiortc.RTCSessionDescription(content["sdp"], "answer"))
        track = await asyncio.wait_for(arrived, 10)
        return [await asyncio.wait_for(track.recv(), 20) for _ in range(frames)]
    finally:
        await peer.close()


def test_pictures_arrive_and_are_those_of_the_robot(running: Running) -> None:
    frames = asyncio.run(watch(running, 2, 10))
    assert (frames[-1].width, frames[-1].height) == (320, 180)
    rgb = frames[-1].to_ndarray(format="rgb24")
    assert abs(int(rgb[90, 160, 0]) - 80) < 25
    assert [frame.pts for frame in frames] == sorted(frame.pts for frame in frames)


IN_A_BROWSER = """async () => {
    const headers = {"X-Tutelage": "1", "Content-Type": "application/json"};
    const post = (path, body) => fetch(path, {method: "POST", headers, body: JSON.stringify(body)});
    await post("/api/login", {name: "ana", password: PASSWORD});
    const peer = new RTCPeerConnection({iceServers: []});
    peer.addTransceiver("video", {direction: "recvonly"});
    const video = document.createElement("video");
    video.muted = true;
    peer.ontrack = (event) => { video.srcObject = new MediaStream([event.track]); video.play(); };
    await peer.setLocalDescription(await peer.createOffer());
    while (peer.iceGatheringState !== "complete") await new Promise((done) => setTimeout(done, 50));
    const answer = await (await post("/api/webrtc", {sdp: peer.localDescription.sdp, type: "offer", robot: 2})).json();
    await peer.setRemoteDescription({type: "answer", sdp: answer.sdp});
    for (let i = 0; i < 200 && !video.videoWidth; i++) await new Promise((done) => setTimeout(done, 100));
    return [peer.connectionState, video.videoWidth, video.videoHeight];
}""".replace("PASSWORD", f'"{PASSWORD}"')


def test_pictures_arrive_in_a_browser(running: Running) -> None:
    with chromium() as browser:
        page = browser.new_page()
        page.goto(running.origin)
        assert page.evaluate(IN_A_BROWSER) == ["connected", 320, 180]


SDP = """v=0
o=- 1 1 IN IP4 198.51.100.7
s=-
c=IN IP4 198.51.100.7
a=candidate:1 1 udp 2113937151 2d3f1c6e-name.local 50123 typ host generation 0
a=candidate:2 1 UDP 2113937151 198.51.100.7 50124 typ host
a=candidate:3 1 udp 2113937151 198.51.100.7 22 typ host
a=candidate:4 1 udp 1 198.51.100.7 50125 typ srflx raddr 0.0.0.0 rport 9
a=candidate:5 1 tcp 1 198.51.100.7 9 typ host tcptype active
a=candidate:6
"""


def test_candidates_are_believed_to_be_where_the_offer_came_from() -> None:
    made = believed(SDP, "192.0.2.9")
    assert "198.51.100.7" not in made.replace("o=- 1 1 IN IP4 198.51.100.7", "")
    assert "local" not in made
    assert [line for line in made.splitlines() if line.startswith("a=candidate")] == [
        "a=candidate:1 1 udp 2113937151 192.0.2.9 50123 typ host",
        "a=candidate:2 1 UDP 2113937151 192.0.2.9 50124 typ host",
    ]


@given(st.text(max_size=200))
def test_any_text_is_an_offer_or_none(sdp: str) -> None:
    believed(sdp, "192.0.2.9")


@pytest.mark.parametrize(
    ("change", "status"),
    [({"sdp": "v=0"}, 400), ({"sdp": "nonsense"}, 400), ({"sdp": SDP}, 400), ({"robot": 99}, 400), ({"camera": 9}, 400),
     ({"type": "answer"}, 422), ({"sdp": "x" * 40_000}, 422), ({"fps": 0}, 422), ({"more": 1}, 422)],
)  # fmt: skip
def test_bad_offers_are_refused(running: Running, change: dict[str, Any], status: int) -> None:
    before = running.numbers()["tutelage_webrtc_peers"]
    with contextlib.closing(running.client("viewer")) as client:
        answer = client.post("/api/webrtc", json={"sdp": SDP, "type": "offer", "robot": 0} | change)
        assert answer.status_code == status
        assert answer.json().keys() == {"error"}
    assert running.numbers()["tutelage_webrtc_peers"] <= before  # peers of other tests may go meanwhile


def test_strangers_get_no_pictures(running: Running) -> None:
    headers = {"origin": running.origin, "x-tutelage": "1"}
    answer = httpx.post(f"{running.origin}/api/webrtc", json={"sdp": SDP, "type": "offer", "robot": 0}, headers=headers)
    assert answer.status_code == 401
    assert PASSWORD not in answer.text
