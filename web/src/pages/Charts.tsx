/** How the fleet does, live. */

import { signal } from "@preact/signals";
import { clock, duration, milliseconds, number, percent, plural, words } from "../format";
import { Chart } from "../parts/Chart";
import type { MetricsRow } from "../protocol";
import { metrics } from "../store";

interface Kind {
  keys: string[];
  title: string;
  say: string;
  format: (value: number) => string;
  tone: string;
  step?: boolean;
  range?: [number, number];
}

const KINDS: Kind[] = [
  { keys: ["successes"], title: "Successes", say: "Tasks completed since the start", format: number, tone: "tone-good", step: true },
  { keys: ["rohe"], title: "Return on human effort", say: "ROHE, eq. 5.2", format: number, tone: "tone-accent" },
  { keys: ["intervention_rate"], title: "Intervention rate", say: "Share of robot time with a person", format: percent, tone: "tone-driven" },
  { keys: ["idle_time"], title: "Idle time", say: "Timesteps that robots stood in violation or reset", format: number, tone: "tone-violated" },
  { keys: ["queue_wait"], title: "Wait in the queue", say: "Mean time from request to help", format: duration, tone: "tone-switching" },
  { keys: ["hard_resets"], title: "Hard resets", say: "Since the start", format: number, tone: "tone-resetting", step: true },
  { keys: ["human_steps"], title: "Human steps", say: "Timesteps of human control since the start", format: number, tone: "tone-driven", step: true },
  { keys: ["policy_version"], title: "Policy version", say: "How often people's corrections changed the policy", format: number, tone: "tone-accent", step: true },
];
const HIDDEN = new Set(["t", "time", ...KINDS.flatMap((kind) => kind.keys)]);

const windows: [string, number][] = [["5 min", 300], ["30 min", 1800], ["All", Infinity]];
const span = signal(300);
const allShown = signal(false);

export function Charts() {
  const rows = metrics.value;
  const last = rows.at(-1);
  if (!last) {
    return (
      <section class="page">
        <h1 class="head">Charts</h1>
        <p class="nobody">No numbers yet.</p>
      </section>
    );
  }
  const to = last.time;
  const first = rows[0]?.time ?? to;
  const from = Math.max(first, to - span.value);
  const more = Object.keys(last).filter((key) => !HIDDEN.has(key) && rows.some((row) => typeof row[key] === "number"));
  const kinds = KINDS.filter((kind) => kind.keys.some((key) => key in last));
  const others = more.map((key): Kind => ({ keys: [key], title: words(key), say: "", format: key.endsWith("_ms") ? milliseconds : number, tone: "tone-plain" }));
  const grid = (which: Kind[]) => (
    <div class="charts">
      {which.map((kind) => {
        const lines = kind.keys.map((key) => ({ name: words(key), tone: kind.tone, points: points(rows, key) }));
        return (
          <div key={kind.title} class="chart-cell" title={kind.say}>
            <Chart
              title={kind.title}
              lines={lines}
              format={kind.format}
              formatX={(x) => (x >= to - 0.5 ? "now" : `−${clock(to - x)}`)}
              from={from}
              to={Math.max(to, from + 1)}
              step={kind.step ?? lines.every((line) => line.points.every((point) => Number.isInteger(point.y)))}
            />
            {kind.say ? <p class="chart-say">{kind.say}</p> : null}
          </div>
        );
      })}
    </div>
  );
  return (
    <section class="page">
      <div class="page-bar">
        <h1 class="head">Charts</h1>
        <fieldset class="segments small" aria-label="Time shown">
          {windows.map(([text, seconds]) => (
            <label key={text}>
              <input type="radio" name="window" checked={span.value === seconds} onChange={() => (span.value = seconds)} />
              <span>{text}</span>
            </label>
          ))}
        </fieldset>
        <span class="quiet num">timestep {number(last.t)}</span>
      </div>
      {grid(kinds)}
      {others.length ? (
        <details class="numbers" open={allShown.value} onToggle={(event) => (allShown.value = event.currentTarget.open)}>
          <summary>{plural(others.length, "more chart")}</summary>
          {allShown.value ? grid(others) : null}
        </details>
      ) : null}
      <Table rows={rows} keys={kinds.flatMap((kind) => kind.keys)} />
    </section>
  );
}

function points(rows: MetricsRow[], key: string): { x: number; y: number }[] {
  const found: { x: number; y: number }[] = [];
  for (const row of rows) {
    const y = row[key];
    if (typeof y === "number" && Number.isFinite(y)) found.push({ x: row.time, y });
  }
  return found;
}

/** The same numbers for those who do not see lines. */
function Table({ rows, keys }: { rows: MetricsRow[]; keys: string[] }) {
  return (
    <details class="numbers">
      <summary>The last numbers as a table</summary>
      <div class="table-scroll">
        <table>
          <thead>
            <tr>
              <th scope="col">Timestep</th>
              {keys.map((key) => (
                <th key={key} scope="col" class="right">
                  {words(key)}
                </th>
              ))}
            </tr>
          </thead>
          <tbody>
            {rows.slice(-12).reverse().map((row) => (
              <tr key={row.t}>
                <th scope="row" class="num">
                  {row.t}
                </th>
                {keys.map((key) => (
                  <td key={key} class="num right">
                    {number(row[key])}
                  </td>
                ))}
              </tr>
            ))}
          </tbody>
        </table>
      </div>
    </details>
  );
}
