/** What each person has done, and what they do now. */

import { clock, duration, milliseconds, moment, number, words } from "../format";
import { useLoad } from "../parts/load";
import type { OperatorRow } from "../protocol";
import * as store from "../store";

/** How to write a statistic, judged by its name. */
export function written(key: string, value: unknown): string {
  if (value == null) return "–";
  if (typeof value === "boolean") return value ? "yes" : "no";
  if (typeof value !== "number") return String(value);
  if (key.includes("latency") || key.endsWith("_ms") || key.endsWith("p50") || key.endsWith("p99")) return milliseconds(value);
  if (["since", "joined", "last_seen"].includes(key)) return moment(value);
  if (key.endsWith("human_time") || key === "human_seconds") return clock(value);
  if (key.includes("time") || key.includes("acceptance") || key.endsWith("_s") || key.includes("seconds")) return duration(value);
  return number(value);
}

const NOT_COLUMNS = new Set(["operator", "name", "present", "online", "robot", "available", "seat", "role"]);

export function Operators() {
  const { data, error } = useLoad<{ rows: OperatorRow[] }>("/api/operators", 3);
  const rows = data?.rows ?? [];
  const columns = [...new Set(rows.flatMap((row) => Object.keys(row)))].filter((key) => !NOT_COLUMNS.has(key));
  return (
    <section class="page">
      <div class="page-bar">
        <h1 class="head">Operators</h1>
        <span class="quiet">{store.fleet.value ? `${store.fleet.value.humans} seats` : ""}</span>
      </div>
      {error ? <p class="error-line">{error}</p> : null}
      {data && !rows.length ? <p class="nobody">Nobody has worked here yet.</p> : null}
      {rows.length ? (
        <div class="table-scroll">
          <table>
            <thead>
              <tr>
                <th scope="col">Operator</th>
                <th scope="col">Now</th>
                {columns.map((key) => (
                  <th key={key} scope="col" class="right">
                    {words(key.replace(/_ms$/, ""))}
                  </th>
                ))}
              </tr>
            </thead>
            <tbody>
              {rows.map((row) => (
                <tr key={row.operator}>
                  <th scope="row">{row.operator}</th>
                  <td>{doing(row)}</td>
                  {columns.map((key) => (
                    <td key={key} class="num right">
                      {written(key, row[key])}
                    </td>
                  ))}
                </tr>
              ))}
            </tbody>
          </table>
        </div>
      ) : null}
    </section>
  );
}

function doing(row: OperatorRow): string {
  const held = Object.entries(store.snapshot.value?.leases ?? {}).find(([, lease]) => lease.operator === row.operator);
  const robot = typeof row.robot === "number" ? row.robot : held ? Number(held[0]) : null;
  if (robot !== null) return `drives ${store.robotName(robot)}`;
  if (!row.online && !row.present) return "away";
  return row.available === false ? "on a break" : "free";
}
