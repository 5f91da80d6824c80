/** What surrounds every page: where you are, how the connection is, and the emergency stop. */

import type { ComponentChildren } from "preact";
import { useState } from "preact/hooks";
import { errorText, post } from "../api";
import { setSound, soundOn, soundReady, unlock } from "../chime";
import { giveBackKey, resetKey } from "../drive";
import { keyLabel, milliseconds } from "../format";
import { disconnect, retryNow, setAvailable } from "../live";
import { route } from "../route";
import * as store from "../store";
import { setTheme, theme, type Theme } from "../theme";
import { stopVideo } from "../video";
import { EStop } from "./EStop";

interface Place {
  page: string;
  text: string;
  path: string;
  allowed?: () => boolean;
}

const PLACES: Place[] = [
  { page: "", text: "Robots", path: "#/" },
  { page: "charts", text: "Charts", path: "#/charts" },
  { page: "operators", text: "Operators", path: "#/operators" },
  { page: "replay", text: "Replay", path: "#/replay" },
  { page: "audit", text: "Audit", path: "#/audit", allowed: () => store.canOperate.value },
  { page: "accounts", text: "Accounts", path: "#/accounts", allowed: () => store.isAdmin.value },
];

const ICONS: Record<string, string> = {
  queue: "M3 4h10M3 8h10M3 12h6",
  "": "M2.5 3h4.5v4.5H2.5zM9 3h4.5v4.5H9zM2.5 9.5H7V14H2.5zM9 9.5h4.5V14H9z",
  charts: "M2 13.5h12M2.5 11l3.5-4 3 2.5 4.5-6",
  more: "M3 8h.01M8 8h.01M13 8h.01",
};

function current(page: string): boolean {
  const here = route.value.page;
  return here === page || (page === "" && here === "robot");
}

export function Shell({ children }: { children: ComponentChildren }) {
  return (
    <div class="shell" onPointerDown={soundOn.value && !soundReady.value ? unlock : undefined}>
      <a class="skip" href="#main" onClick={(event) => { event.preventDefault(); document.getElementById("main")?.focus(); }}>
        Skip to the content
      </a>
      <header class="bar">
        <a class="brand" href="#/" aria-label="Tutelage: robots">
          <svg viewBox="0 0 32 32" aria-hidden="true">
            <path d="M5 8h20M15 8v17" stroke="currentColor" stroke-width="4" stroke-linecap="round" fill="none" />
            <circle cx="24.5" cy="23" r="4" class="brand-dot" />
          </svg>
          <span class="brand-task">{store.fleet.value?.task ?? "Tutelage"}</span>
        </a>
        <nav class="places" aria-label="Pages">
          {PLACES.filter((place) => place.allowed?.() ?? true).map((place) => (
            <a key={place.page} href={place.path} aria-current={current(place.page) ? "page" : undefined}>
              {place.text}
            </a>
          ))}
        </nav>
        <div class="bar-end">
          <Link />
          <Availability />
          <Person />
          <EStop />
        </div>
      </header>
      <Banner />
      <main id="main" tabIndex={-1}>
        {children}
      </main>
      <nav class="tabs" aria-label="Pages">
        <Tab page="queue" text="Queue" path="#/queue" badge={store.offers.value.size || store.queue.value.length} />
        <Tab page="" text="Robots" path="#/" />
        <Tab page="charts" text="Charts" path="#/charts" />
        <Tab page="more" text="More" path="#/more" />
      </nav>
    </div>
  );
}

function Tab({ page, text, path, badge = 0 }: { page: string; text: string; path: string; badge?: number }) {
  const here = current(page) || (page === "more" && ["operators", "replay", "audit", "accounts"].includes(route.value.page));
  return (
    <a href={path} aria-current={here ? "page" : undefined}>
      <svg viewBox="0 0 16 16" aria-hidden="true">
        <path d={ICONS[page]} fill="none" stroke="currentColor" stroke-width={page === "more" ? 2.6 : 1.6} stroke-linecap="round" stroke-linejoin="round" />
      </svg>
      {text}
      {badge ? <span class="badge">{badge}</span> : null}
    </a>
  );
}

export function Link() {
  const kind = store.connection.value.kind;
  const late = store.silent(1.5);
  const bad = kind !== "open" || late;
  const text = kind === "open" ? (late ? "no state" : milliseconds(store.rtt.value === null ? null : store.rtt.value * 1000)) : kind === "lost" ? "offline" : "connecting";
  return (
    <span class={`link ${bad ? "link-bad" : ""}`} title="Connection to the server, and its round trip">
      <i aria-hidden="true" />
      <span class="sr">Connection: </span>
      {text}
    </span>
  );
}

function Availability() {
  if (!store.canOperate.value || store.me.value?.seat === null) return null;
  const on = store.available.value;
  return (
    <button type="button" class="switch" role="switch" aria-checked={on} onClick={() => void setAvailable(!on)} title="On a break you are offered nothing">
      <i aria-hidden="true" />
      <span>{on ? "Available" : "On a break"}</span>
    </button>
  );
}

export function signOut(): void {
  void post("/api/logout").catch(() => undefined).then(() => {
    disconnect();
    stopVideo();
    store.me.value = null;
  });
}

export function Preferences() {
  const themes: [Theme, string][] = [["system", "System"], ["light", "Light"], ["dark", "Dark"]];
  return (
    <>
      <fieldset class="segments">
        <legend>Colours</legend>
        {themes.map(([value, text]) => (
          <label key={value}>
            <input type="radio" name="theme" checked={theme.value === value} onChange={() => setTheme(value)} />
            <span>{text}</span>
          </label>
        ))}
      </fieldset>
      <label class="check">
        <input type="checkbox" checked={soundOn.value} onChange={(event) => setSound(event.currentTarget.checked)} />
        Chime for requests
        {soundOn.value && !soundReady.value ? <span class="quiet"> (after your first click)</span> : null}
      </label>
    </>
  );
}

function Person() {
  const person = store.me.value;
  if (!person) return null;
  return (
    <details class="person" onKeyDown={(event) => { if (event.key === "Escape") event.currentTarget.removeAttribute("open"); }} onFocusOut={(event) => {
      if (!event.currentTarget.contains(event.relatedTarget as Node | null) && event.relatedTarget) event.currentTarget.removeAttribute("open");
    }}>
      <summary aria-label={`${person.name}, ${person.role}: settings and sign-out`}>
        <span class="initial" aria-hidden="true">{person.name.slice(0, 1).toUpperCase()}</span>
        <span class="person-name">{person.name}</span>
      </summary>
      <div class="popover">
        <p class="quiet">
          {person.name} · {person.role}
          {person.seat !== null ? ` · seat ${person.seat + 1}` : ""}
        </p>
        <Preferences />
        <Shortcuts />
        <Password />
        <button type="button" class="button" onClick={signOut}>
          Sign out
        </button>
      </div>
    </details>
  );
}

/** One's own password. */
export function Password() {
  const [open, setOpen] = useState(false);
  const [old, setOld] = useState("");
  const [fresh, setFresh] = useState("");
  const [error, setError] = useState<string | null>(null);
  if (!open) {
    return (
      <button type="button" class="button" onClick={() => setOpen(true)}>
        Change password…
      </button>
    );
  }
  const submit = async (event: Event): Promise<void> => {
    event.preventDefault();
    try {
      await post("/api/password", { old, new: fresh }, true);
      store.note("Your password is changed; your other sessions ended.");
      setOpen(false);
      setOld("");
      setFresh("");
      setError(null);
    } catch (reason) {
      setError(errorText(reason));
    }
  };
  return (
    <form class="password" onSubmit={(event) => void submit(event)}>
      <input type="text" class="sr" tabIndex={-1} aria-hidden="true" autocomplete="username" readOnly value={store.me.value?.name ?? ""} />
      <label class="field-label">
        Old password
        <input type="password" autocomplete="current-password" required value={old} onInput={(event) => setOld(event.currentTarget.value)} />
      </label>
      <label class="field-label">
        New password
        <input type="password" autocomplete="new-password" required value={fresh} onInput={(event) => setFresh(event.currentTarget.value)} />
      </label>
      {error ? (
        <p class="error-line" role="alert">
          {error}
        </p>
      ) : null}
      <div class="inline">
        <button type="submit" class="button primary" disabled={!old || !fresh}>
          Change
        </button>
        <button type="button" class="button" onClick={() => setOpen(false)}>
          Cancel
        </button>
      </div>
    </form>
  );
}

export function Shortcuts() {
  return (
    <dl class="shortcuts">
      <dt><kbd>Esc</kbd></dt>
      <dd>stop the robot you drive</dd>
      <dt><kbd>Esc</kbd> <kbd>Esc</kbd></dt>
      <dd>stop all robots</dd>
      <dt><kbd>A</kbd></dt>
      <dd>accept the first offer</dd>
      <dt><kbd>D</kbd></dt>
      <dd>decline it</dd>
      <dt><kbd>{keyLabel(giveBackKey())}</kbd></dt>
      <dd>give back</dd>
      <dt><kbd>{keyLabel(resetKey())}</kbd></dt>
      <dd>hard reset</dd>
    </dl>
  );
}

export function Banner() {
  const state = store.connection.value;
  if (state.kind === "lost") {
    const seconds = Math.max(0, Math.ceil(state.retryAt - store.now.value));
    return (
      <div class="banner banner-bad" role="alert">
        <span>The connection to the server is lost. Robots that you drove hold still.</span>
        <span aria-hidden="true" class="num">{seconds ? `Trying again in ${seconds} s` : "Trying again…"}</span>
        <button type="button" class="button" onClick={retryNow}>
          Try now
        </button>
      </div>
    );
  }
  if (state.kind === "open" && store.silent(2)) {
    return (
      <div class="banner banner-warn" role="alert">
        Nothing was heard from the loop for {Math.round(store.now.value - (store.stateAt.value ?? 0))} s: what you see is old.
      </div>
    );
  }
  if (store.allStopped.value) {
    return (
      <div class="banner banner-stop" role="status">
        All robots are stopped.
      </div>
    );
  }
  if (store.canOperate.value && store.me.value?.seat === null && state.kind === "open") {
    return (
      <div class="banner banner-warn" role="status">
        All seats are taken: you can watch and stop robots, and are offered none.
      </div>
    );
  }
  return null;
}
