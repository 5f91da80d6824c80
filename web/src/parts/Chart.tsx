/** A line over time with one quiet grid, and a cross-hair that all charts of a page share. */

import { signal } from "@preact/signals";
import { useEffect, useRef, useState } from "preact/hooks";
import { bounds, nearest, thin, ticks, type Point } from "../series";

export interface Line {
  name: string;
  points: Point[];
  /** One of the style sheet's classes for lines. */
  tone: string;
}

interface Props {
  title: string;
  lines: Line[];
  format: (value: number) => string;
  formatX: (x: number) => string;
  from: number;
  to: number;
  height?: number;
  range?: [number, number];
  /** A mark that stays: where a replay is. */
  at?: number | null;
  onPick?: (x: number) => void;
  step?: boolean;
}

const cross = signal<number | null>(null);
const PAD = { left: 44, right: 8, top: 8, bottom: 18 };

export function Chart(props: Props) {
  const box = useRef<HTMLDivElement>(null);
  const [width, setWidth] = useState(360);
  useEffect(() => {
    const element = box.current;
    if (!element) return;
    const sized = new ResizeObserver(() => setWidth(Math.max(160, element.clientWidth)));
    sized.observe(element);
    return () => sized.disconnect();
  }, []);
  const height = props.height ?? 160;
  const inner = { width: width - PAD.left - PAD.right, height: height - PAD.top - PAD.bottom };
  const shown = props.lines.map((line) => ({ ...line, points: thin(line.points.filter((p) => p.x >= props.from && p.x <= props.to), 400) }));
  const [low, high] = props.range ?? bounds(shown.flatMap((line) => line.points.map((p) => p.y)));
  const span = Math.max(1e-9, props.to - props.from);
  const sx = (x: number): number => PAD.left + ((x - props.from) / span) * inner.width;
  const sy = (y: number): number => PAD.top + (1 - (y - low) / (high - low)) * inner.height;
  const path = (points: Point[]): string =>
    points
      .map((p, k) => {
        const [x, y] = [sx(p.x).toFixed(1), sy(p.y).toFixed(1)];
        return k === 0 ? `M${x} ${y}` : props.step ? `H${x}V${y}` : `L${x} ${y}`;
      })
      .join("");
  const x = cross.value;
  const inside = x !== null && x >= props.from && x <= props.to;
  const toX = (event: PointerEvent): number => {
    const rect = (event.currentTarget as Element).getBoundingClientRect();
    return props.from + ((event.clientX - rect.left - PAD.left) / inner.width) * span;
  };
  const at = inside ? x : null;
  const readings = shown.map((line) => {
    const point = at === null ? line.points.at(-1) : line.points[nearest(line.points, at)];
    return { line, point };
  });
  return (
    <figure class="chart">
      <figcaption>
        <span class="chart-title">{props.title}</span>
        <span class="chart-reading">
          {readings.map(({ line, point }) => (
            <span key={line.name} class={`reading ${line.tone}`}>
              {shown.length > 1 ? <span class="reading-name">{line.name}</span> : null}
              <span class="num">{point ? props.format(point.y) : "–"}</span>
            </span>
          ))}
        </span>
      </figcaption>
      <div ref={box} class="chart-box">
        <svg
          width={width}
          height={height}
          role="img"
          aria-label={`${props.title}: ${readings.map(({ line, point }) => `${line.name} ${point ? props.format(point.y) : "no value"}`).join(", ")}`}
          onPointerMove={(event) => (cross.value = toX(event))}
          onPointerLeave={() => (cross.value = null)}
          onPointerDown={props.onPick ? (event) => props.onPick?.(toX(event)) : undefined}
        >
          {ticks(low, high, 3).filter((y) => !props.step || Number.isInteger(y)).map((y) => (
            <g key={y}>
              <line class="grid" x1={PAD.left} x2={width - PAD.right} y1={sy(y)} y2={sy(y)} />
              <text class="tick" x={PAD.left - 6} y={sy(y) + 3.5} text-anchor="end">
                {props.format(y)}
              </text>
            </g>
          ))}
          <text class="tick" x={PAD.left} y={height - 4}>
            {props.formatX(props.from)}
          </text>
          <text class="tick" x={width - PAD.right} y={height - 4} text-anchor="end">
            {props.formatX(props.to)}
          </text>
          {shown.map((line) => (
            <path key={line.name} class={`line ${line.tone}`} d={path(line.points)} />
          ))}
          {props.at !== undefined && props.at !== null ? <line class="playhead" x1={sx(props.at)} x2={sx(props.at)} y1={PAD.top} y2={PAD.top + inner.height} /> : null}
          {at !== null ? (
            <g>
              <line class="cross" x1={sx(at)} x2={sx(at)} y1={PAD.top} y2={PAD.top + inner.height} />
              {readings.map(({ line, point }) => (point ? <circle key={line.name} class={`dot ${line.tone}`} cx={sx(point.x)} cy={sy(point.y)} r={3} /> : null))}
              <text class="tick cross-text" x={Math.min(width - 40, Math.max(PAD.left + 24, sx(at)))} y={height - 4} text-anchor="middle">
                {props.formatX(at)}
              </text>
            </g>
          ) : null}
        </svg>
      </div>
    </figure>
  );
}
