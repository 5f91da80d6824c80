/** Concentration: find the pairs among cards that lie face down. The server knows the cards; the page shows what is turned. */

import { useEffect, useRef, useState } from "preact/hooks";
import { ApiError, errorText, post } from "../api";
import type { Board } from "../protocol";
import { note } from "../store";

/** Twelve pictures that differ in shape and in name, so that nobody needs to tell colours. */
const PICTURES: [string, string][] = [
  ["circle", "M12 4a8 8 0 1 0 .01 0Z"],
  ["square", "M5 5h14v14H5Z"],
  ["triangle", "M12 4 21 19.5H3Z"],
  ["star", "M12 3l2.6 6.1 6.6.6-5 4.4 1.5 6.5-5.7-3.5-5.7 3.5 1.5-6.5-5-4.4 6.6-.6Z"],
  ["heart", "M12 20.500C5 15.5 3 12 3 8.9 3 6.2 5.1 4.5 7.4 4.500c1.9 0 3.6 1.1 4.6 2.9 1-1.8 2.7-2.9 4.6-2.900C18.9 4.5 21 6.2 21 8.900c0 3.1-2 6.6-9 11.600Z"],
  ["moon", "M15 3.500A9 9 0 1 0 20.5 16 7.5 7.5 0 0 1 15 3.500Z"],
  ["drop", "M12 3c4 5 6 8 6 11a6 6 0 0 1-12 0c0-3 2-6 6-11Z"],
  ["cross", "M9 4h6v5h5v6h-5v5H9v-5H4V9h5Z"],
  ["diamond", "M12 3l7 9-7 9-7-9Z"],
  ["ring", "M12 3.500a8.5 8.5 0 1 0 .01 0ZM12 8a4 4 0 1 1-.01 0Z"],
  ["bolt", "M14 2.5 5 13.500h5.500L9 21.500l9.5-11.500H13Z"],
  ["house", "M12 4l9 8h-3v8H6v-8H3Z"],
];

const PEEK = 1100; // ms that a pair that does not match stays face up

interface Turned {
  card: number;
  picture: number;
  pair: boolean | null;
  board: Board;
}

export function Cards({ board }: { board: Board }) {
  const [peek, setPeek] = useState<ReadonlyMap<number, number>>(new Map());
  const [shown, setShown] = useState(board);
  const [busy, setBusy] = useState(false);
  const first = useRef<[number, number] | null>(null);
  const timer = useRef(0);
  useEffect(() => setShown(board), [board]);
  useEffect(() => () => window.clearTimeout(timer.current), []);

  const turn = async (card: number): Promise<void> => {
    if (busy || peek.size) return;
    setBusy(true);
    try {
      const answer = await post<Turned>("/api/study/turn", { card });
      setShown(answer.board);
      if (answer.pair === null) first.current = [answer.card, answer.picture];
      else {
        // The second card of a turn is seen for a moment, whatever the server's table looks like by then.
        const seen = new Map<number, number>([[answer.card, answer.picture]]);
        if (first.current) seen.set(...first.current);
        setPeek(seen);
        timer.current = window.setTimeout(() => setPeek(new Map()), answer.pair ? 500 : PEEK);
        first.current = null;
      }
    } catch (error) {
      if (!(error instanceof ApiError && error.status === 409)) note(errorText(error), "warning");
    } finally {
      setBusy(false);
    }
  };
  return (
    <div class="cards-game">
      <p class="cards-score" role="status">
        Pairs <strong class="num">{shown.pairs}</strong>
      </p>
      <ol class={`cards cards-${shown.cards}`}>
        {Array.from({ length: shown.cards }, (_, card) => {
          const picture = peek.get(card) ?? shown.face_up[String(card)];
          const [name, path] = picture === undefined ? [null, ""] : (PICTURES[picture % PICTURES.length] ?? [null, ""]);
          return (
            <li key={card}>
              <button
                type="button"
                class={name === null ? "card" : "card card-up"}
                aria-label={name === null ? `Card ${card + 1}, face down` : `Card ${card + 1}: ${name}`}
                aria-disabled={name !== null || peek.size > 0}
                onClick={() => (name === null ? void turn(card) : undefined)}
              >
                {name === null ? null : (
                  <svg viewBox="0 0 24 24" aria-hidden="true" class={`picture-${picture}`}>
                    <path d={path} fill="currentColor" fill-rule="evenodd" />
                  </svg>
                )}
              </button>
            </li>
          );
        })}
      </ol>
    </div>
  );
}
