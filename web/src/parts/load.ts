/** Data of a page: loaded when the page opens, again on request, and with a line where that fails. */

import { useCallback, useEffect, useState } from "preact/hooks";
import { errorText, get } from "../api";

export interface Loaded<T> {
  data: T | null;
  error: string | null;
  reload: () => void;
}

export function useLoad<T>(path: string | null, every: number | null = null): Loaded<T> {
  const [data, setData] = useState<T | null>(null);
  const [error, setError] = useState<string | null>(null);
  const [turn, setTurn] = useState(0);
  useEffect(() => {
    if (path === null) return;
    let gone = false;
    get<T>(path).then(
      (answer) => {
        if (gone) return;
        setData(answer);
        setError(null);
      },
      (reason: unknown) => {
        if (!gone) setError(errorText(reason));
      },
    );
    return () => {
      gone = true;
    };
  }, [path, turn]);
  useEffect(() => {
    if (every === null) return;
    const timer = window.setInterval(() => {
      if (!document.hidden) setTurn((n) => n + 1);
    }, every * 1000);
    return () => window.clearInterval(timer);
  }, [every]);
  return { data, error, reload: useCallback(() => setTurn((n) => n + 1), []) };
}
