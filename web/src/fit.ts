/** How many columns of 16:9 pictures fill a space best. Pure. */

const NARROWEST = 208;
const LINE = 34; // px under each picture

/** Columns for n tiles in width x height px: as few as fit without scrolling, else as many as stay legible. */
export function columnsFor(n: number, width: number, height: number, gap = 10): number {
  const most = Math.max(1, Math.floor((width + gap) / (NARROWEST + gap)));
  for (let columns = 1; columns < most; columns += 1) {
    const tile = (width - gap * (columns - 1)) / columns;
    const rows = Math.ceil(n / columns);
    if (rows * ((tile * 9) / 16 + LINE + gap) - gap <= height) return columns;
  }
  return most;
}
