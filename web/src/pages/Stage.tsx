/** One robot, large: what it does, and everything that a person can do to it. */

import { signal, useComputed, type Signal } from "@preact/signals";
import { useEffect, useRef, useState } from "preact/hooks";
import { get } from "../api";
import { dragTo, drop, giveBackKey, held, letGo, resetKey, sending, type Spot } from "../drive";
import { clock, duration, keyLabel, milliseconds, plural } from "../format";
import { fitted, normalised, onPlane } from "../inputs";
import { giveBack, hardReset, handOver, takeOver } from "../live";
import { LOOK_TEXT, Mode as ModeNumber, reasonText } from "../modes";
import { confirmDialog } from "../parts/Dialog";
import { askToClear } from "../parts/EStop";
import { Mode } from "../parts/Glyph";
import { PeerPicture } from "../parts/PeerPicture";
import { Picture } from "../parts/Picture";
import { Ribbon } from "../parts/Ribbon";
import type { OperatorRow } from "../protocol";
import { emergencyStop } from "../stop";
import * as store from "../store";
import { noStats, type ViewStats } from "../video";
import { Controls, noGesture } from "./Controls";
import { Tile, withWhom } from "./Wall";

const way = signal<"jpeg" | "webrtc">("jpeg");
const byPeer = (): boolean => way.value === "webrtc" && store.fleet.value?.webrtc === true;

function noPeer(why: string): void {
  way.value = "jpeg";
  store.note(`No pictures by WebRTC: ${why}. JPEG goes on.`, "warning");
}

/** How the large picture comes, where the server has both ways. */
function Way() {
  if (!store.fleet.value?.webrtc) return null;
  return (
    <fieldset class="segments small way" aria-label="Pictures by">
      {(["jpeg", "webrtc"] as const).map((value) => (
        <label key={value}>
          <input type="radio" name="way" checked={way.value === value} onChange={() => (way.value = value)} />
          <span>{value === "jpeg" ? "JPEG" : "WebRTC"}</span>
        </label>
      ))}
    </fieldset>
  );
}

export function Stage({ index }: { index: number }) {
  const cell = store.robots.value[index];
  if (!cell) {
    return (
      <section class="stage">
        <p class="nobody">{store.snapshot.value ? `There is no robot ${index}.` : "Waiting for the fleet…"}</p>
      </section>
    );
  }
  return <Known index={index} />;
}

function Known({ index }: { index: number }) {
  const cell = store.robots.value[index];
  const [stats] = useState(() => signal<ViewStats>(noStats()));
  const mine = store.lease.value?.robot === index;
  const controls = store.fleet.value?.controls;
  const cameras = store.fleet.value?.cameras ?? [];
  const [camera, setCamera] = useState(controls?.pointer?.camera ?? 0);
  const frame = useRef<HTMLDivElement>(null);
  useEffect(() => {
    if (mine) frame.current?.focus({ preventScroll: false });
  }, [mine]);
  if (!cell) return null;
  const robot = cell.value;
  return (
    <section class={`stage look-${robot.look} ${mine ? "stage-mine" : ""}`} aria-label={robot.name}>
      <header class="stage-head">
        <a class="back" href="#/" aria-label="Back to all robots">
          ←
        </a>
        <h1>{robot.name}</h1>
        <Mode look={robot.look} note={withWhom(robot)} />
        {robot.reason && robot.look !== "auto" && robot.reason !== robot.look && !(robot.reason === "asked" && robot.operator) ? <span class="stage-reason">{reasonText(robot.reason)}</span> : null}
        {cameras.length > 1 ? (
          <fieldset class="segments small cameras" aria-label="Camera">
            {cameras.map((name, k) => (
              <label key={name}>
                <input type="radio" name="camera" checked={camera === k} onChange={() => setCamera(k)} />
                <span>{name}</span>
              </label>
            ))}
          </fieldset>
        ) : null}
        <Way />
      </header>
      <div class="stage-body">
        <div class="stage-left">
          <View frame={frame} index={index} camera={camera} stats={stats} mine={mine} />
          <Ribbon robot={index} />
          <Hud stats={stats} mine={mine} />
        </div>
        <aside class="panel" aria-label="Control">
          <Actions index={index} mine={mine} />
          {mine && controls && robot.look !== "violated" && robot.look !== "resetting" ? <Controls controls={controls} /> : null}
        </aside>
      </div>
      <Strip except={index} />
    </section>
  );
}

export function View({ frame, index, camera, stats, mine }: { frame: { current: HTMLDivElement | null }; index: number; camera: number; stats: Signal<ViewStats>; mine: boolean }) {
  const pointer = store.fleet.value?.controls.pointer;
  const usable = mine && !!pointer && pointer.camera === camera;
  const name = store.robotName(index);
  const old = useComputed(() => {
    const captured = stats.value.captured;
    return captured === null ? null : store.now.value + store.clockSync.offset - captured;
  });
  const at = (event: PointerEvent): Spot | null => {
    const box = frame.current?.querySelector(".picture")?.getBoundingClientRect();
    const { width, height } = stats.value;
    if (!box || !pointer || !width) return null; // there is no picture yet
    const picture = normalised(event.clientX, event.clientY, fitted(box, width, height));
    return { picture, plane: onPlane(picture, width, height, pointer.view) };
  };
  const start = useRef<Spot | null>(null);
  const listeners = usable
    ? {
        onTouchStart: noGesture,
        onPointerDown: (event: PointerEvent) => {
          if (event.button !== 0) return;
          event.preventDefault();
          frame.current?.focus();
          (event.currentTarget as HTMLElement).setPointerCapture(event.pointerId);
          start.current = at(event);
          if (start.current) dragTo({ from: start.current, to: start.current });
        },
        onPointerMove: (event: PointerEvent) => {
          const to = at(event);
          if (start.current && to) dragTo({ from: start.current, to });
        },
        onPointerUp: () => {
          if (start.current) drop();
          start.current = null;
        },
        onPointerCancel: () => {
          start.current = null;
          letGo();
        },
      }
    : {};
  const drag = held.value.drag;
  const tooOld = old.value !== null && old.value > 1 && !store.fleet.value?.lockstep;
  return (
    <div
      ref={frame}
      class={`view ${usable ? "view-pointer" : ""} ${tooOld ? "view-old" : ""} ${mine && sending.value ? "view-live" : ""}`}
      tabIndex={mine ? 0 : -1}
      role={mine ? "application" : "group"}
      aria-label={mine ? `Driving ${name}. ${store.fleet.value?.controls.help ?? ""}` : `Picture of ${name}`}
      {...listeners}
    >
      {byPeer() ? (
        <PeerPicture robot={index} camera={camera} label={`Live picture of ${name}`} stats={stats} onFail={noPeer} />
      ) : (
        <Picture robot={index} camera={camera} fps={20} priority={2} label={`Live picture of ${name}`} stats={stats} />
      )}
      {usable && drag ? <Arrow from={drag.from.picture} to={drag.to.picture} width={stats.value.width} height={stats.value.height} /> : null}
      {tooOld && old.value !== null ? <p class="view-note">Picture is {duration(old.value)} old</p> : null}
      {old.value === null ? <p class="view-note">Waiting for a picture…</p> : null}
      <Progress index={index} />
    </div>
  );
}

function Arrow({ from, to, width, height }: { from: [number, number]; to: [number, number]; width: number; height: number }) {
  const [x0, y0, x1, y1] = [from[0] * width, from[1] * height, to[0] * width, to[1] * height];
  const unit = width / 60;
  const angle = Math.atan2(y1 - y0, x1 - x0);
  const wing = (turn: number): string => `${x1 + unit * 1.6 * Math.cos(angle + turn)},${y1 + unit * 1.6 * Math.sin(angle + turn)}`;
  return (
    <svg class="arrow" viewBox={`0 0 ${width} ${height}`} preserveAspectRatio="xMidYMid meet" aria-hidden="true">
      <circle cx={x0} cy={y0} r={unit * 0.7} />
      <line x1={x0} y1={y0} x2={x1} y2={y1} stroke-width={unit * 0.45} />
      <polyline points={`${wing(2.6)} ${x1},${y1} ${wing(-2.6)}`} stroke-width={unit * 0.45} />
    </svg>
  );
}

/** How far a hard reset is. */
function Progress({ index }: { index: number }) {
  const state = store.snapshot.value;
  const description = store.fleet.value;
  if (!state || !description || state.mode[index] !== ModeNumber.RESETTING) return null;
  const steps = description.t_reset;
  const age = state.age[index] ?? 0;
  return (
    <p class="view-note view-reset">
      Hard reset{steps ? `: ${duration(Math.max(0, steps - age) / description.hz)} left` : `, ${duration(age / description.hz)}`}
      {steps ? <progress max={steps} value={age} /> : null}
    </p>
  );
}

function Hud({ stats, mine }: { stats: { value: ViewStats }; mine: boolean }) {
  void store.now.value;
  const picture = stats.value.captured === null ? null : store.serverNow() - stats.value.captured;
  const state = store.stateAt.value === null ? null : Date.now() / 1000 - store.stateAt.value;
  const rtt = store.rtt.value;
  const p99 = store.link.value.p99;
  const cells: [string, string, boolean][] = [
    ["Round trip", milliseconds(rtt === null ? null : rtt * 1000), rtt !== null && rtt > 0.25],
    ["Pictures", `${stats.value.fps.toFixed(0)} /s`, stats.value.fps < 2],
    [byPeer() ? "Last picture" : "Picture age", picture === null ? "–" : milliseconds(picture * 1000), picture !== null && picture > 0.7],
    ["State age", state === null ? "–" : milliseconds(state * 1000), state !== null && state > 0.7],
    ["Command p99", milliseconds(p99), p99 !== null && p99 > 100],
  ];
  return (
    <dl class="hud" aria-label="Connection">
      {cells.map(([name, value, bad]) => (
        <div key={name} class={bad ? "hud-bad" : ""}>
          <dt>{name}</dt>
          <dd class="num">{value}</dd>
        </div>
      ))}
      {mine ? (
        <div>
          <dt>Late, dropped</dt>
          <dd class="num">{store.link.value.dropped}</dd>
        </div>
      ) : null}
    </dl>
  );
}

export function askReset(index: number): void {
  const t = store.fleet.value;
  confirmDialog({
    title: `Hard reset of ${store.robotName(index)}?`,
    body: (
      <p>
        The robot is brought back to a start state.
        {t?.t_reset ? ` It takes ${duration(t.t_reset / t.hz)}, and the present episode ends.` : " The present episode ends."}
      </p>
    ),
    yes: "Reset",
    danger: true,
    onYes: () => hardReset(index),
  });
}

function Actions({ index, mine }: { index: number; mine: boolean }) {
  const cell = store.robots.value[index];
  if (!cell) return null;
  const robot = cell.value;
  if (!store.canOperate.value) {
    return (
      <div class="actions">
        <p class="quiet">You watch. Operators can take over.</p>
      </div>
    );
  }
  const offered = store.offers.value.get(index);
  const asked = store.asked.value.has(index);
  const others = robot.operator !== null && !mine;
  const stop = robot.stopped ? (
    <button type="button" class="button" onClick={() => askToClear(index, robot.name)}>
      Clear this stop…
    </button>
  ) : (
    <button type="button" class="button stop-one" onClick={() => void emergencyStop(index)} aria-keyshortcuts={mine ? "Escape" : undefined}>
      Stop this robot {mine ? <kbd>Esc</kbd> : null}
    </button>
  );
  if (mine) {
    const resetting = robot.mode === ModeNumber.RESETTING;
    const fallen = robot.reason === "violated" && !resetting;
    const since = store.snapshot.value?.leases[String(index)]?.since;
    return (
      <div class="actions">
        <p class="driving">
          <strong>{resetting ? "Resetting" : fallen ? "It needs a hard reset" : robot.held ? "It holds: press something" : "You drive"}</strong>
          {since !== undefined && !fallen ? <span class="num">{clock(store.now.value + store.clockSync.offset - since)}</span> : null}
        </p>
        {fallen ? <p class="quiet">It violated its constraint and stands still. After the reset it goes on by itself; take it over again if it needs more.</p> : null}
        <div class="action-grid">
          <button type="button" class={`button ${fallen ? "" : "primary"}`} disabled={resetting} onClick={() => void giveBack(index)} aria-keyshortcuts={keyLabel(giveBackKey())}>
            Give back <kbd>{keyLabel(giveBackKey())}</kbd>
          </button>
          <button type="button" class={`button ${fallen ? "primary" : ""}`} disabled={resetting} onClick={() => askReset(index)} aria-keyshortcuts={keyLabel(resetKey())}>
            Hard reset… <kbd>{keyLabel(resetKey())}</kbd>
          </button>
          <HandOver index={index} />
          {stop}
        </div>
      </div>
    );
  }
  return (
    <div class="actions">
      {others ? (
        <p class="quiet">
          {robot.operator} has this robot{robot.held ? " and gives no command: it holds." : "."}
        </p>
      ) : null}
      <div class="action-grid">
        {others ? null : (
          <button
            type="button"
            class="button primary"
            disabled={asked || store.connection.value.kind !== "open" || store.lease.value !== null || !robot.online || robot.stopped || store.me.value?.seat === null}
            onClick={() => void takeOver(index)}
          >
            {asked ? "Waiting for it…" : offered ? "Accept" : "Take over"} {offered ? <kbd>A</kbd> : null}
          </button>
        )}
        {stop}
      </div>
      {store.lease.value !== null ? (
        <p class="quiet">
          You drive <a href={`#/robot/${store.lease.value.robot}`}>{store.robotName(store.lease.value.robot)}</a>; give it back first.
        </p>
      ) : null}
      {robot.stopped ? <p class="quiet">It is stopped until somebody clears the stop.</p> : null}
      {!robot.online && !robot.stopped ? <p class="quiet">{LOOK_TEXT.offline}: it cannot be reached.</p> : null}
    </div>
  );
}

function HandOver({ index }: { index: number }) {
  const [people, setPeople] = useState<OperatorRow[] | null>(null);
  const element = useRef<HTMLDetailsElement>(null);
  const load = (): void => {
    if (!element.current?.open) return;
    void get<{ rows: OperatorRow[] }>("/api/operators").then(
      ({ rows }) => setPeople(rows.filter((row) => row.operator !== store.me.value?.name && (row.online || row.present))),
      () => setPeople([]),
    );
  };
  return (
    <details class="hand-over" ref={element} onToggle={load}>
      <summary class="button">Hand over…</summary>
      <div class="popover">
        {people === null ? <p class="quiet">Who is there…</p> : null}
        {people?.length === 0 ? <p class="quiet">Nobody else is here.</p> : null}
        {people?.map((person) => (
          <button
            key={person.operator}
            type="button"
            class="button"
            onClick={() => {
              element.current?.removeAttribute("open");
              void handOver(index, person.operator).then((ok) => {
                if (ok) store.note(`Offered to ${person.operator}; you keep it until they accept.`);
              });
            }}
          >
            {person.operator}
            {typeof person.robot === "number" ? <span class="quiet"> drives {store.robotName(person.robot)}</span> : null}
            {person.available === false ? <span class="quiet"> on a break</span> : null}
          </button>
        ))}
      </div>
    </details>
  );
}

/** The others, small, so that nobody is forgotten while one is driven. */
function Strip({ except }: { except: number }) {
  const cells = store.robots.value.filter((cell) => cell.peek().index !== except);
  if (!cells.length) return null;
  return (
    <div class="strip-section">
      <h2 class="sub">{plural(cells.length, "other")}</h2>
      <ul class="wall wall-s strip">
        {cells.map((cell) => (
          <Tile key={cell.peek().index} cell={cell} fps={2} camera={0} />
        ))}
      </ul>
    </div>
  );
}
