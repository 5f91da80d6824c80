/** The large picture by WebRTC: for links on which one lost packet should not hold up what follows. Else JPEG as usual. */

import type { Signal } from "@preact/signals";
import { useEffect, useRef } from "preact/hooks";
import { errorText, post } from "../api";
import { serverNow } from "../store";
import { noStats, type ViewStats } from "../video";

interface Props {
  robot: number;
  camera: number;
  label: string;
  stats: Signal<ViewStats>;
  /** Called once where no picture comes. */
  onFail: (why: string) => void;
}

const PATIENCE = 8000; // ms until the first picture

async function gathered(peer: RTCPeerConnection): Promise<void> {
  if (peer.iceGatheringState === "complete") return;
  await new Promise<void>((done) => {
    const timer = window.setTimeout(done, 2000);
    peer.addEventListener("icegatheringstatechange", () => {
      if (peer.iceGatheringState !== "complete") return;
      window.clearTimeout(timer);
      done();
    });
  });
}

export function PeerPicture({ robot, camera, label, stats, onFail }: Props) {
  const element = useRef<HTMLVideoElement>(null);
  useEffect(() => {
    const video = element.current;
    if (!video) return;
    stats.value = noStats();
    const peer = new RTCPeerConnection({ iceServers: [] });
    let gone = false;
    let times: number[] = [];
    const fail = (why: string): void => {
      if (gone) return;
      gone = true;
      onFail(why);
    };
    const drawn = (): void => {
      if (gone) return;
      const at = performance.now();
      times = [...times.filter((time) => time > at - 2000), at];
      const span = (at - (times[0] ?? at)) / 1000;
      // A track says nothing of when a picture was taken: what is known is when it came.
      stats.value = { fps: span > 0.2 ? (times.length - 1) / span : 0, age: null, captured: serverNow(), width: video.videoWidth, height: video.videoHeight };
      video.requestVideoFrameCallback(drawn);
    };
    peer.addTransceiver("video", { direction: "recvonly" });
    peer.ontrack = (event) => {
      video.srcObject = new MediaStream([event.track]);
      void video.play().catch(() => undefined);
      video.requestVideoFrameCallback(drawn);
    };
    peer.onconnectionstatechange = () => {
      if (peer.connectionState === "failed") fail("the connection failed");
    };
    const timer = window.setTimeout(() => {
      if (!times.length) fail("no picture came");
    }, PATIENCE);
    void (async () => {
      try {
        await peer.setLocalDescription(await peer.createOffer());
        await gathered(peer);
        if (gone) return;
        const offer = { sdp: peer.localDescription?.sdp ?? "", type: "offer", robot, camera, width: 960, height: 540, fps: 20 };
        const answer = await post<{ sdp: string }>("/api/webrtc", offer);
        if (!gone) await peer.setRemoteDescription({ type: "answer", sdp: answer.sdp });
      } catch (error) {
        fail(errorText(error));
      }
    })();
    return () => {
      gone = true;
      window.clearTimeout(timer);
      peer.close();
      video.srcObject = null;
    };
  }, [robot, camera]);
  return <video ref={element} class="picture" muted playsInline disablePictureInPicture aria-label={label} />;
}
