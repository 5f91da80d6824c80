/** The shape of a state: told apart without colour. */

import type { Look } from "../modes";
import { LOOK_TEXT } from "../modes";

const SHAPES: Record<Look, preact.JSX.Element> = {
  auto: <circle cx="8" cy="8" r="4.5" fill="none" stroke="currentColor" stroke-width="2" />,
  asking: (
    <g>
      <circle cx="8" cy="8" r="5.5" fill="none" stroke="currentColor" stroke-width="2" />
      <circle cx="8" cy="8" r="2" fill="currentColor" />
    </g>
  ),
  switching: (
    <g>
      <circle cx="8" cy="8" r="5.5" fill="none" stroke="currentColor" stroke-width="2" />
      <path d="M8 2.5a5.5 5.5 0 0 1 0 11z" fill="currentColor" />
    </g>
  ),
  driven: <circle cx="8" cy="8" r="6.5" fill="currentColor" />,
  violated: (
    <path d="M8 1.2 15.4 14.4H.6ZM7 6v4h2V6Zm0 5.2V13h2v-1.8z" fill="currentColor" fill-rule="evenodd" />
  ),
  resetting: (
    <g fill="none" stroke="currentColor" stroke-width="2">
      <path d="M13.3 5.5A6 6 0 1 0 14 8.5" />
      <path d="M14.5 1.800v4h-4" />
    </g>
  ),
  offline: (
    <g fill="none" stroke="currentColor" stroke-width="2">
      <circle cx="8" cy="8" r="5.5" stroke-dasharray="2.6 1.720" />
    </g>
  ),
  stopped: <path d="M5 .8h6L15.2 5v6L11 15.200H5L.8 11V5ZM5 5v6h6V5Z" fill="currentColor" fill-rule="evenodd" />,
  held: <path d="M4 2.5h3v11H4zM9 2.5h3v11H9z" fill="currentColor" />,
};

export function Glyph({ look }: { look: Look }) {
  return (
    <svg class={`glyph look-${look}`} viewBox="0 0 16 16" aria-hidden="true">
      {SHAPES[look]}
    </svg>
  );
}

export function Mode({ look, note }: { look: Look; note?: string | undefined }) {
  return (
    <span class={`mode look-${look}`}>
      <Glyph look={look} />
      <span>
        {LOOK_TEXT[look]}
        {note ? <span class="mode-note">{note.startsWith("by ") ? " " : " · "}{note}</span> : null}
      </span>
    </span>
  );
}
