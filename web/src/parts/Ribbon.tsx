/** The last minute and a half of a robot's states, one column a second. */

import { useSignalEffect } from "@preact/signals";
import { useRef } from "preact/hooks";
import { history, historyTick, lookOfCode, RIBBON } from "../store";
import { colour, palette } from "../theme";

let colours = new Map<string, string>();
let drawnWith = -1;

function of(look: string): string {
  if (drawnWith !== palette.value) {
    colours = new Map();
    drawnWith = palette.value;
  }
  let found = colours.get(look);
  if (found === undefined) {
    found = colour(`--ribbon-${look}`);
    colours.set(look, found);
  }
  return found;
}

export function Ribbon({ robot }: { robot: number }) {
  const canvas = useRef<HTMLCanvasElement>(null);
  useSignalEffect(() => {
    void historyTick.value;
    void palette.value;
    const row = history.value[robot];
    const context = canvas.current?.getContext("2d");
    if (!row || !context) return;
    context.clearRect(0, 0, RIBBON, 1);
    row.forEach((code, x) => {
      const look = lookOfCode(code);
      if (!look) return;
      context.fillStyle = of(look);
      context.fillRect(x, 0, 1, 1);
    });
  });
  return <canvas ref={canvas} class="ribbon" width={RIBBON} height={1} aria-hidden="true" />;
}
