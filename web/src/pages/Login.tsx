/** The way in; and the first account of a new server, by its one-time link. */

import { useEffect, useRef, useState } from "preact/hooks";
import { ApiError, errorText, post } from "../api";
import { unlock } from "../chime";
import type { Role } from "../protocol";
import { me } from "../store";

interface Props {
  /** The token of the one-time set-up link. */
  setup: string | null;
}

export function Login({ setup }: Props) {
  const [name, setName] = useState("");
  const [password, setPassword] = useState("");
  const [error, setError] = useState<string | null>(null);
  const [busy, setBusy] = useState(false);
  const [wait, setWait] = useState(0);
  const first = useRef<HTMLInputElement>(null);
  useEffect(() => first.current?.focus(), []);
  useEffect(() => {
    if (wait <= 0) return;
    const timer = window.setTimeout(() => setWait(wait - 1), 1000);
    return () => window.clearTimeout(timer);
  }, [wait]);

  const submit = async (event: Event): Promise<void> => {
    event.preventDefault();
    unlock();
    setBusy(true);
    setError(null);
    try {
      const answer = await (setup ? post<{ name: string; role: Role }>("/api/setup", { token: setup, name, password }, true) : post<{ name: string; role: Role }>("/api/login", { name, password }, true));
      if (setup) location.hash = "#/";
      me.value = { ...answer, seat: null };
    } catch (reason) {
      setError(errorText(reason));
      if (reason instanceof ApiError && reason.retryAfter) setWait(Math.ceil(reason.retryAfter));
      setPassword("");
    } finally {
      setBusy(false);
    }
  };
  return (
    <main class="login">
      <form onSubmit={(event) => void submit(event)} aria-labelledby="login-title">
        <svg class="login-mark" viewBox="0 0 32 32" aria-hidden="true">
          <path d="M5 8h20M15 8v17" stroke="currentColor" stroke-width="3.5" stroke-linecap="round" fill="none" />
          <circle cx="24.5" cy="23" r="3.8" class="brand-dot" />
        </svg>
        <h1 id="login-title">{setup ? "Set up this server" : "Tutelage"}</h1>
        <p class="quiet">{setup ? "Make the first account: an administrator's." : "A few people keep many robots working."}</p>
        <label class="field-label">
          Name
          <input ref={first} type="text" name="username" autocomplete="username" autocapitalize="none" spellcheck={false} required value={name} onInput={(event) => setName(event.currentTarget.value)} />
        </label>
        <label class="field-label">
          Password
          <input type="password" name="password" autocomplete={setup ? "new-password" : "current-password"} required value={password} aria-describedby={setup ? "password-rule" : undefined} onInput={(event) => setPassword(event.currentTarget.value)} />
        </label>
        {setup ? (
          <p class="quiet" id="password-rule">
            At least 10 characters.
          </p>
        ) : null}
        <p class="error-line" role="alert">
          {error ? (wait > 0 ? `${error} Try again in ${wait} s.` : error) : ""}
        </p>
        <button type="submit" class="button primary" disabled={busy || wait > 0 || !name || !password}>
          {busy ? "One moment…" : setup ? "Create and sign in" : "Sign in"}
        </button>
      </form>
    </main>
  );
}
