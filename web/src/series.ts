/** Lines of a chart: which points to draw, and where the ticks are. Pure. */

export interface Point {
  x: number;
  y: number;
}

/** At most about `most` points that keep every peak and dip: the lowest and highest of each piece. */
export function thin(points: Point[], most: number): Point[] {
  if (points.length <= most) return points;
  const size = Math.ceil((points.length / most) * 2);
  const kept: Point[] = [];
  for (let start = 0; start < points.length; start += size) {
    const piece = points.slice(start, start + size);
    let low = piece[0] as Point;
    let high = low;
    for (const point of piece) {
      if (point.y < low.y) low = point;
      if (point.y > high.y) high = point;
    }
    kept.push(...(low === high ? [low] : low.x < high.x ? [low, high] : [high, low]));
  }
  const last = points.at(-1);
  if (last && kept.at(-1) !== last) kept.push(last);
  return kept;
}

/** Round numbers from low to high, about `count` of them. */
export function ticks(low: number, high: number, count = 4): number[] {
  if (!(high > low)) return [low];
  const raw = (high - low) / count;
  const power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 2.5, 5, 10].map((m) => m * power).find((s) => s >= raw * 0.999) ?? 10 * power;
  const found: number[] = [];
  for (let k = Math.ceil(low / step - 1e-9); k * step <= high + step * 1e-9; k += 1) found.push(Number((k * step).toPrecision(12)));
  return found;
}

/** The bounds of a chart: from 0 where the numbers are positive, and never empty. */
export function bounds(values: number[]): [number, number] {
  let [low, high] = [Infinity, -Infinity];
  for (const value of values) {
    if (value < low) low = value;
    if (value > high) high = value;
  }
  if (!Number.isFinite(low)) return [0, 1];
  low = Math.min(0, low);
  if (high <= low) high = low + 1;
  return [low, high + (high - low) * 0.06];
}

/** The index of the point nearest to x; points are sorted by x. */
export function nearest(points: Point[], x: number): number {
  let [a, b] = [0, points.length - 1];
  while (b - a > 1) {
    const middle = (a + b) >> 1;
    if ((points[middle]?.x ?? 0) < x) a = middle;
    else b = middle;
  }
  return Math.abs((points[a]?.x ?? 0) - x) <= Math.abs((points[b]?.x ?? 0) - x) ? a : b;
}
