/** What moves the robot: keys and where they stand, sticks for fingers, the assist button. */

import { useRef } from "preact/hooks";
import { held, padName, setAssist, setSwitch, setTouch } from "../drive";
import { keyLabel, signed } from "../format";
import { assistKey, scale } from "../inputs";
import type { Axis, Controls as Description } from "../protocol";

export function Controls({ controls }: { controls: Description }) {
  const stick = stickOf(controls);
  const rest = controls.axes.map((_, k) => k).filter((k) => !stick || !stick.includes(k));
  return (
    <div class="controls">
      {controls.help || controls.pointer ? <p class="quiet help">{controls.help || POINTER[controls.pointer?.kind ?? ""]}</p> : null}
      {controls.axes.length ? (
        <ul class="axes">
          {controls.axes.map((axis, k) => (
            <AxisRow key={k} axis={axis} k={k} />
          ))}
        </ul>
      ) : null}
      {controls.axes.length ? (
        <div class="fingers" aria-label="On-screen controls">
          {stick ? <Stick x={stick[0]} y={stick[1]} controls={controls} /> : null}
          {rest.length ? (
            <div class="holds">
              {rest.map((k) => {
                const axis = controls.axes[k];
                return axis ? <Holds key={k} axis={axis} k={k} /> : null;
              })}
            </div>
          ) : null}
        </div>
      ) : null}
      {controls.assist ? <Assist controls={controls} /> : null}
      {padName.value ? <p class="quiet">Gamepad: {padName.value}</p> : null}
    </div>
  );
}

const POINTER: Record<string, string> = {
  push: "On the picture: press, drag the way it is to move, and let go.",
  go: "On the picture: press where the robot is to go; it moves while you hold.",
  pick_place: "On the picture: press on what to pick and drag to where it is to be placed.",
};

/** Two axes on the arrow keys, or the first two: a stick for a thumb. [x, y] by position. */
function stickOf(controls: Description): [number, number] | null {
  const find = (low: string, high: string): number =>
    controls.axes.findIndex((axis) => !axis.toggle && ((axis.keys[0] === low && axis.keys[1] === high) || (axis.keys[0] === high && axis.keys[1] === low)));
  for (const [left, right, up, down] of [["ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown"], ["KeyA", "KeyD", "KeyW", "KeyS"]] as const) {
    const [x, y] = [find(left, right), find(up, down)];
    if (x >= 0 && y >= 0) return [x, y];
  }
  return null;
}

/** A drag on the controls is not a fling of the page: after one, the browser would swallow the next tap, on whatever it is. */
export function noGesture(event: Event): void {
  event.preventDefault();
}

function AxisRow({ axis, k }: { axis: Axis; k: number }) {
  const value = held.value.values[k] ?? 0;
  const [low = "", high = ""] = axis.keys;
  return (
    <li class={value ? "axis axis-on" : "axis"}>
      {low ? <kbd class={value < 0 ? "kbd-on" : ""}>{keyLabel(low)}</kbd> : <span />}
      <span class="axis-label">{axis.label}</span>
      <svg class="gauge" viewBox="-1 -1 2 2" preserveAspectRatio="none" aria-hidden="true">
        <rect x={Math.min(0, value)} y={-1} width={Math.abs(value)} height={2} />
        <line x1={0} x2={0} y1={-1} y2={1} />
      </svg>
      <span class="num axis-value">{signed(scale(axis, value))}</span>
      {high && high !== low ? <kbd class={value > 0 ? "kbd-on" : ""}>{keyLabel(high)}</kbd> : <span />}
    </li>
  );
}

/** A stick for a finger: analogue, and back to the middle when it lets go. */
function Stick({ x, y, controls }: { x: number; y: number; controls: Description }) {
  const base = useRef<HTMLDivElement>(null);
  const down = useRef(false);
  const [ax, ay] = [controls.axes[x], controls.axes[y]];
  // Up on the screen is whichever end of the axis the key for "up" stands for.
  const flipY = ay?.keys[1] === "ArrowUp" || ay?.keys[1] === "KeyW" ? -1 : 1;
  const flipX = ax?.keys[1] === "ArrowLeft" || ax?.keys[1] === "KeyA" ? -1 : 1;
  const move = (event: PointerEvent): void => {
    const box = base.current?.getBoundingClientRect();
    if (!box || !down.current) return;
    let dx = ((event.clientX - box.left) / box.width) * 2 - 1;
    let dy = ((event.clientY - box.top) / box.height) * 2 - 1;
    const far = Math.max(1, Math.hypot(dx, dy));
    [dx, dy] = [dx / far, dy / far];
    setTouch(x, Math.abs(dx) < 0.12 ? 0 : dx * flipX);
    setTouch(y, Math.abs(dy) < 0.12 ? 0 : dy * flipY);
  };
  const up = (): void => {
    down.current = false;
    setTouch(x, 0);
    setTouch(y, 0);
  };
  const [vx, vy] = [(held.value.values[x] ?? 0) * flipX, (held.value.values[y] ?? 0) * flipY];
  return (
    <div
      ref={base}
      class="stick"
      aria-hidden="true"
      onTouchStart={noGesture}
      onPointerDown={(event) => {
        event.preventDefault();
        base.current?.setPointerCapture(event.pointerId);
        down.current = true;
        move(event);
      }}
      onPointerMove={move}
      onPointerUp={up}
      onPointerCancel={up}
    >
      <svg viewBox="-1.2 -1.2 2.4 2.4">
        <circle class="stick-base" r="1.1" />
        <path class="stick-cross" d="M-1.1 0h2.2M0-1.1v2.2" />
        <circle class={vx || vy ? "stick-knob stick-on" : "stick-knob"} cx={vx * 0.72} cy={vy * 0.72} r="0.36" />
      </svg>
      <span>
        {ax?.label} · {ay?.label}
      </span>
    </div>
  );
}

function Holds({ axis, k }: { axis: Axis; k: number }) {
  const hold = (value: number) =>
    axis.toggle
      ? { onClick: () => setSwitch(k, value > 0) }
      : {
          onTouchStart: noGesture,
          onPointerDown: (event: PointerEvent) => {
            event.preventDefault();
            (event.currentTarget as HTMLElement).setPointerCapture(event.pointerId);
            setTouch(k, value);
          },
          onPointerUp: () => setTouch(k, 0),
          onPointerCancel: () => setTouch(k, 0),
          onContextMenu: (event: Event) => event.preventDefault(),
        };
  const value = held.value.values[k] ?? 0;
  return (
    <div class={axis.low < 0 || axis.toggle ? "hold" : "hold hold-one"}>
      {axis.low < 0 || axis.toggle ? (
        <button type="button" tabIndex={-1} class={value < 0 ? "button on" : "button"} aria-label={`${axis.label}: less`} {...hold(-1)}>
          −
        </button>
      ) : null}
      <span>{axis.label}</span>
      <button type="button" tabIndex={-1} class={value > 0 ? "button on" : "button"} aria-label={`${axis.label}: more`} {...hold(1)}>
        +
      </button>
    </div>
  );
}

function Assist({ controls }: { controls: Description }) {
  const key = assistKey(controls);
  const on = held.value.assist;
  return (
    <button
      type="button"
      class={`button assist ${on ? "on" : ""}`}
      tabIndex={-1}
      onTouchStart={noGesture}
      onPointerDown={(event) => {
        event.preventDefault();
        event.currentTarget.setPointerCapture(event.pointerId);
        setAssist(true);
      }}
      onPointerUp={() => setAssist(false)}
      onPointerCancel={() => setAssist(false)}
      onContextMenu={(event) => event.preventDefault()}
    >
      {on ? "The expert acts for you" : "Hold: the expert acts for you"} {key ? <kbd>{keyLabel(key)}</kbd> : null}
    </button>
  );
}
