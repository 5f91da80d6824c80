/** A canvas with a robot's live picture. It asks for pictures only while it is on the screen. */

import { signal, type Signal } from "@preact/signals";
import { useEffect, useRef, useState } from "preact/hooks";
import { addView, noStats, soon, type View, type ViewStats } from "../video";

interface Props {
  robot: number;
  camera: number;
  fps: number;
  priority?: number;
  label: string;
  stats?: Signal<ViewStats>;
  class?: string;
}

export function Picture(props: Props) {
  const canvas = useRef<HTMLCanvasElement>(null);
  const [own] = useState(() => signal<ViewStats>(noStats()));
  const stats = props.stats ?? own;
  const view = useRef<View | null>(null);

  useEffect(() => {
    const element = canvas.current;
    if (!element) return;
    stats.value = noStats();
    const mine: View = {
      robot: props.robot,
      camera: props.camera,
      width: element.clientWidth || 320,
      fps: props.fps,
      priority: props.priority ?? 0,
      visible: false,
      canvas: element,
      stats,
    };
    view.current = mine;
    const gone = addView(mine);
    const seen = new IntersectionObserver(
      (entries) => {
        mine.visible = entries.at(-1)?.isIntersecting ?? false;
        soon();
      },
      { threshold: 0.02 },
    );
    const sized = new ResizeObserver(() => {
      mine.width = element.clientWidth || mine.width;
      soon();
    });
    seen.observe(element);
    sized.observe(element);
    return () => {
      seen.disconnect();
      sized.disconnect();
      gone();
      view.current = null;
    };
  }, [props.robot, props.camera]);

  useEffect(() => {
    if (!view.current) return;
    view.current.fps = props.fps;
    view.current.priority = props.priority ?? 0;
    soon();
  }, [props.fps, props.priority]);

  return <canvas ref={canvas} class={`picture ${props.class ?? ""}`} width={16} height={9} role="img" aria-label={props.label} />;
}
