/** An intervention again: pictures, and what the policy proposed beside what was executed. */

import { useEffect, useMemo, useRef, useState } from "preact/hooks";
import { clock, duration, moment, signed, words } from "../format";
import { lookOfMode } from "../modes";
import { Chart } from "../parts/Chart";
import { Mode } from "../parts/Glyph";
import { useLoad } from "../parts/load";
import type { Episode, EpisodeFrame, EpisodeRow } from "../protocol";
import { route } from "../route";
import { fleet, robotName } from "../store";

export function Replay() {
  const { data, error, reload } = useLoad<{ rows: EpisodeRow[] }>("/api/episodes?limit=200");
  const id = route.value.id;
  const rows = data?.rows ?? [];
  return (
    <section class={`page replay ${id ? "replay-open" : ""}`}>
      <div class="replay-list">
        <div class="page-bar">
          <h1 class="head">Replay</h1>
          <button type="button" class="button" onClick={reload}>
            Refresh
          </button>
        </div>
        {error ? <p class="error-line">{error}</p> : null}
        {data && !rows.length ? <p class="nobody">Nobody has helped a robot yet. What people do is kept and shown here.</p> : null}
        <ul class="episodes">
          {rows.map((row) => (
            <li key={row.id}>
              <a href={`#/replay/${row.id}`} aria-current={String(row.id) === id ? "true" : undefined}>
                <span class="episode-name">{robotName(row.robot)}</span>
                <span class="num quiet">{moment(row.began)}</span>
                <span class="quiet">
                  {row.operator ?? "–"} · {duration(row.seconds)}
                </span>
                <span class={`outcome outcome-${row.outcome}`}>{words(row.outcome || "open")}</span>
              </a>
            </li>
          ))}
        </ul>
      </div>
      {id ? <Player key={id} id={id} /> : <p class="nobody replay-hint">Choose an intervention.</p>}
    </section>
  );
}

function Player({ id }: { id: string }) {
  const { data, error } = useLoad<Episode>(`/api/episodes/${encodeURIComponent(id)}`);
  if (error) return <p class="error-line">{error}</p>;
  if (!data) return <p class="nobody">Loading…</p>;
  if (!data.frames.length) return <p class="nobody">Nothing was recorded in it.</p>;
  return <Film episode={data} />;
}

const SPEEDS = [0.5, 1, 2, 4];

function Film({ episode }: { episode: Episode }) {
  const frames = episode.frames;
  const hz = fleet.value?.hz ?? 10;
  const [at, setAt] = useState(0);
  const [playing, setPlaying] = useState(false);
  const [speed, setSpeed] = useState(1);
  const [shown, setShown] = useState<string | null>(null);
  const [missing, setMissing] = useState(false);
  const wanted = useRef(0);
  const frame = frames[at] as EpisodeFrame;

  useEffect(() => {
    if (!playing) return;
    const timer = window.setInterval(() => {
      setAt((k) => {
        if (k + 1 >= frames.length) {
          setPlaying(false);
          return k;
        }
        return k + 1;
      });
    }, 1000 / (hz * speed));
    return () => window.clearInterval(timer);
  }, [playing, speed, hz, frames.length]);

  // Pictures are drawn by the server on demand: one request at a time, for the newest place of the scrubber.
  useEffect(() => {
    wanted.current = at;
    let gone = false;
    const image = new Image();
    const url = `/api/episodes/${encodeURIComponent(String(episode.id))}/frames/${at}.jpg`;
    image.onload = () => {
      if (!gone || wanted.current >= at) setShown(url);
      setMissing(false);
    };
    image.onerror = () => {
      if (!gone) setMissing(true);
    };
    image.src = url;
    return () => {
      gone = true;
    };
  }, [at]);

  const lines = useMemo(() => dimensions(frames), [frames]);
  const last = frames.length - 1;
  return (
    <div class="player">
      <header class="stage-head">
        <a class="back" href="#/replay" aria-label="Back to the list">
          ←
        </a>
        <h2>{robotName(episode.robot)}</h2>
        <Mode look={lookOfMode(frame.mode)} note={episode.operator && frame.mode ? `${frame.mode === 1 || frame.mode === 3 ? "with" : "by"} ${episode.operator}` : undefined} />
        <span class={`outcome outcome-${episode.outcome}`}>{words(episode.outcome || "open")}</span>
      </header>
      <div class="view">
        {shown && !missing ? <img class="picture" src={shown} alt={`Timestep ${frame.t}`} /> : <div class="picture" />}
        {missing ? <p class="view-note">There is no picture of this timestep.</p> : null}
      </div>
      <div class="transport">
        <button type="button" class="button" aria-label={playing ? "Pause" : "Play"} onClick={() => { if (!playing && at === last) setAt(0); setPlaying(!playing); }}>
          {playing ? "❚❚" : "▶"}
        </button>
        <input
          type="range"
          min={0}
          max={last}
          value={at}
          aria-label="Timestep"
          aria-valuetext={`${at + 1} of ${frames.length}`}
          onInput={(event) => { setPlaying(false); setAt(Number(event.currentTarget.value)); }}
        />
        <span class="num">
          {clock(at / hz)} / {clock(last / hz)}
        </span>
        <label class="inline">
          <span class="sr">Speed</span>
          <select value={speed} onChange={(event) => setSpeed(Number(event.currentTarget.value))}>
            {SPEEDS.map((value) => (
              <option key={value} value={value}>
                {value}×
              </option>
            ))}
          </select>
        </label>
      </div>
      <p class="quiet num">
        Timestep {frame.t} · picture {at + 1} of {frames.length}
      </p>
      <div class="charts dense">
        {lines.map((line, k) => (
          <div key={k} class="chart-cell">
            <Chart
              title={fleet.value?.controls.axes.find((axis) => axis.index === k)?.label ?? `Action ${k}`}
              lines={[
                { name: "proposed", points: line.proposed, tone: "tone-plain dashed" },
                { name: "executed", points: line.action, tone: "tone-driven" },
              ]}
              format={signed}
              formatX={(x) => clock(x / hz)}
              from={0}
              to={Math.max(1, last)}
              height={96}
              range={line.range}
              at={at}
              onPick={(x) => { setPlaying(false); setAt(Math.min(last, Math.max(0, Math.round(x)))); }}
            />
          </div>
        ))}
      </div>
    </div>
  );
}

interface Dimension {
  proposed: { x: number; y: number }[];
  action: { x: number; y: number }[];
  range: [number, number];
}

function dimensions(frames: EpisodeFrame[]): Dimension[] {
  const width = Math.max(0, ...frames.map((frame) => Math.max(frame.action?.length ?? 0, frame.proposed?.length ?? 0)));
  return Array.from({ length: Math.min(width, 12) }, (_, k) => {
    const pick = (key: "action" | "proposed"): { x: number; y: number }[] =>
      frames.flatMap((frame, x) => {
        const y = frame[key]?.[k];
        return typeof y === "number" && Number.isFinite(y) ? [{ x, y }] : [];
      });
    const [proposed, action] = [pick("proposed"), pick("action")];
    const most = Math.max(1, ...[...proposed, ...action].map((p) => Math.abs(p.y)));
    return { proposed, action, range: [-most * 1.05, most * 1.05] };
  });
}
