/** What happened and who did it: a chain of records that shows when one was changed. */

import { useEffect, useState } from "preact/hooks";
import { errorText, get } from "../api";
import { moment, number, words } from "../format";
import type { AuditRow } from "../protocol";
import { fleet, robotName } from "../store";

interface Answer {
  rows: AuditRow[];
  head?: { rows: number; hash: string };
}

interface Check {
  ok: boolean;
  why?: string | null;
  rows: number;
  broken_at: number | null;
}

const PAGE = 100;

export function Audit() {
  const [filters, setFilters] = useState({ kind: "", who: "", robot: "" });
  const [rows, setRows] = useState<AuditRow[] | null>(null);
  const [head, setHead] = useState<string | null>(null);
  const [error, setError] = useState<string | null>(null);
  const [end, setEnd] = useState(false);
  const [check, setCheck] = useState<Check | "busy" | null>(null);

  const load = async (before: number | null): Promise<void> => {
    const query = new URLSearchParams({ limit: String(PAGE) });
    if (before !== null) query.set("before", String(before));
    for (const [key, value] of Object.entries(filters)) if (value) query.set(key, value);
    try {
      const answer = await get<Answer>(`/api/audit?${query.toString()}`);
      setRows((old) => (before === null ? answer.rows : [...(old ?? []), ...answer.rows]));
      setEnd(answer.rows.length < PAGE);
      setHead(answer.head?.hash ?? null);
      setError(null);
    } catch (reason) {
      setError(errorText(reason));
    }
  };
  useEffect(() => {
    void load(null);
  }, [filters.kind, filters.who, filters.robot]);

  const verify = async (): Promise<void> => {
    setCheck("busy");
    try {
      setCheck(await get<Check>("/api/audit/verify"));
    } catch (reason) {
      setCheck(null);
      setError(errorText(reason));
    }
  };
  const kinds = [...new Set((rows ?? []).map((row) => row.kind))].sort();
  return (
    <section class="page">
      <div class="page-bar">
        <h1 class="head">Audit</h1>
        <label class="inline">
          <span class="quiet">Kind</span>
          <input type="text" list="kinds" size={10} value={filters.kind} onChange={(event) => setFilters({ ...filters, kind: event.currentTarget.value.trim() })} />
          <datalist id="kinds">
            {kinds.map((kind) => (
              <option key={kind} value={kind} />
            ))}
          </datalist>
        </label>
        <label class="inline">
          <span class="quiet">Who</span>
          <input type="text" size={10} value={filters.who} onChange={(event) => setFilters({ ...filters, who: event.currentTarget.value.trim() })} />
        </label>
        <label class="inline">
          <span class="quiet">Robot</span>
          <select value={filters.robot} onChange={(event) => setFilters({ ...filters, robot: event.currentTarget.value })}>
            <option value="">any</option>
            {fleet.value?.robots.map((name, k) => (
              <option key={name} value={k}>
                {name}
              </option>
            ))}
          </select>
        </label>
        <button type="button" class="button" onClick={() => void load(null)}>
          Refresh
        </button>
        <button type="button" class="button" disabled={check === "busy"} onClick={() => void verify()}>
          {check === "busy" ? "Verifying…" : "Verify the chain"}
        </button>
      </div>
      <div role="status">
        {check && check !== "busy" ? (
          <p class={check.ok ? "verdict verdict-ok" : "verdict verdict-bad"}>
            {check.ok ? `✓ All ${number(check.rows)} records are as they were written.` : `✗ The record is broken at row ${check.broken_at ?? "?"}: ${check.why ?? "it was changed after it was written"}.`}
          </p>
        ) : null}
      </div>
      {error ? <p class="error-line">{error}</p> : null}
      {rows ? (
        <div class="table-scroll">
          <table class="audit">
            <thead>
              <tr>
                <th scope="col" class="right">
                  No.
                </th>
                <th scope="col">Time</th>
                <th scope="col">Kind</th>
                <th scope="col">Who</th>
                <th scope="col">Robot</th>
                <th scope="col">What</th>
                <th scope="col">Hash</th>
              </tr>
            </thead>
            <tbody>
              {rows.map((row) => (
                <tr key={row.id}>
                  <td class="num right quiet">{row.id}</td>
                  <td class="num">{moment(row.time)}</td>
                  <td>{words(row.kind)}</td>
                  <td>{row.who || "–"}</td>
                  <td>{row.robot === null ? "–" : robotName(row.robot)}</td>
                  <td class="fields">
                    <Fields fields={row.fields} />
                  </td>
                  <td class="mono quiet" title={row.hash}>
                    {row.hash.slice(0, 10)}
                  </td>
                </tr>
              ))}
            </tbody>
          </table>
        </div>
      ) : null}
      {rows && !rows.length ? <p class="nobody">Nothing is recorded that fits.</p> : null}
      <div class="page-bar">
        {rows && !end ? (
          <button type="button" class="button" onClick={() => void load(rows.at(-1)?.id ?? null)}>
            Older
          </button>
        ) : null}
        {head ? (
          <span class="quiet">
            Head of the chain <span class="mono">{head.slice(0, 24)}…</span>
          </span>
        ) : null}
      </div>
    </section>
  );
}

function Fields({ fields }: { fields: Record<string, unknown> }) {
  const entries = Object.entries(fields);
  return (
    <>
      {entries.map(([key, value]) => (
        <span key={key} class="field">
          <span class="quiet">{key}</span> {text(value)}
        </span>
      ))}
    </>
  );
}

function text(value: unknown): string {
  if (typeof value === "number") return Number.isInteger(value) ? String(value) : value.toPrecision(4);
  const said = typeof value === "string" ? value : JSON.stringify(value);
  return said.length > 120 ? `${said.slice(0, 117)}…` : said;
}
