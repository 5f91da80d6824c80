/** A participant's session of the user study (appendix B.4): cards or monitoring panes, robots that call, questions at the end. */

import { effect, signal } from "@preact/signals";
import type { ComponentChildren } from "preact";
import { useEffect, useRef, useState } from "preact/hooks";
import { errorText, post } from "../api";
import { soundReady, unlock } from "../chime";
import { giveBackKey, resetKey } from "../drive";
import { keyLabel } from "../format";
import { giveBack, takeOver } from "../live";
import { Mode as ModeNumber } from "../modes";
import { Mode } from "../parts/Glyph";
import { EStop } from "../parts/EStop";
import { Picture } from "../parts/Picture";
import { Banner, Link, signOut } from "../parts/Shell";
import type { StudyState } from "../protocol";
import * as store from "../store";
import { addView, noStats, type ViewStats } from "../video";
import { Cards } from "./Cards";
import { Controls } from "./Controls";
import { askReset, View } from "./Stage";

type Screen = "cards" | "robots";
const screen = signal<Screen>("cards");
const going = signal(false);

async function next(): Promise<void> {
  if (going.value) return;
  going.value = true;
  unlock();
  try {
    screen.value = "cards";
    await post("/api/study/next");
  } catch (error) {
    store.note(errorText(error), "warning");
  } finally {
    going.value = false;
  }
}

// Who looks at the robots has come to help: what is offered to them is theirs.
effect(() => {
  const state = store.study.value;
  if (state?.interface !== "game" || state.state !== "running" || screen.value !== "robots" || store.lease.value) return;
  for (const robot of store.offers.value.keys()) {
    if (!store.asked.peek().has(robot)) void takeOver(robot);
    break;
  }
});

const TITLES: Record<StudyState["stage"], string> = {
  welcome: "Welcome",
  practice_game: "Practice: the cards",
  practice_requests: "Practice: robots that call you",
  practice_monitoring: "Practice: robots that you watch",
  condition: "Part",
  survey: "Questions",
  done: "Thank you",
};

export function Study({ state }: { state: StudyState }) {
  const title = state.stage === "condition" ? `Part ${state.label} · ${(state.index ?? 0) + 1} of ${state.of}` : TITLES[state.stage];
  const running = state.state === "running";
  const working = running && state.interface !== null && state.stage !== "practice_game";
  return (
    <div class="study" onPointerDown={soundReady.value ? undefined : unlock}>
      <header class="bar">
        <span class="brand">
          <svg viewBox="0 0 32 32" aria-hidden="true">
            <path d="M5 8h20M15 8v17" stroke="currentColor" stroke-width="4" stroke-linecap="round" fill="none" />
            <circle cx="24.5" cy="23" r="4" class="brand-dot" />
          </svg>
          {title}
        </span>
        {state.steps !== null && running ? <progress class="study-progress" max={state.steps} value={state.t} aria-label="How far this part is" /> : null}
        <div class="bar-end">
          <span class="quiet wide">Participant {state.participant}</span>
          <Link />
          <button type="button" class="button" onClick={signOut}>
            Sign out
          </button>
          <EStop />
        </div>
      </header>
      <Banner />
      <main id="main" tabIndex={-1} class={working ? "study-work" : "study-text"}>
        {working ? state.interface === "panes" ? <Panes state={state} /> : <Switching state={state} /> : <Text state={state} />}
      </main>
    </div>
  );
}

function Go({ children }: { children: ComponentChildren }) {
  return (
    <button type="button" class="button primary big" disabled={going.value} onClick={() => void next()}>
      {going.value ? "One moment…" : children}
    </button>
  );
}

const CARDS_RULES = "Turn over two cards at a time and find the pairs. A pair stays open; others are turned back.";
const CALLS_RULES = "Play the cards. When you hear the chime, a robot needs help: go to the robots at once and help it. When no robot needs help the screen is black: go back to the cards.";
const PANES_RULES = "Watch the three robots all the time. Take one over when you think it should be helped: click its picture, drive it, and give it back.";

function Text({ state }: { state: StudyState }) {
  if (state.stage === "survey") return <Survey state={state} />;
  if (state.stage === "done") {
    return (
      <section>
        <h1>Thank you</h1>
        <p>That was all. Everything is saved; you can close this page.</p>
      </section>
    );
  }
  if (state.stage === "welcome") {
    return (
      <section>
        <h1>Welcome</h1>
        <p>You will look after three robots that put a part onto a peg, in {state.of} parts. Between their calls you play a game of cards. First you try everything out.</p>
        <p class="quiet">Turn the sound on: robots call you with a chime.</p>
        <Go>Begin</Go>
      </section>
    );
  }
  if (state.stage === "practice_game") {
    return (
      <section class="study-wide">
        <h1>{TITLES.practice_game}</h1>
        <p>{CARDS_RULES}</p>
        {state.board ? <Cards board={state.board} /> : null}
        <Go>Go on</Go>
      </section>
    );
  }
  if (state.state === "over") {
    return (
      <section>
        <h1>{state.stage === "condition" ? `Part ${state.label} is over` : "That was the practice"}</h1>
        <p>Rest as long as you like.</p>
        <Go>Go on</Go>
      </section>
    );
  }
  return (
    <section>
      <h1>{state.stage === "condition" ? `Part ${state.label}` : TITLES[state.stage]}</h1>
      <p>{state.interface === "panes" ? PANES_RULES : CALLS_RULES}</p>
      <Keys />
      <Go>{state.stage === "condition" ? "Begin" : "Try it"}</Go>
    </section>
  );
}

function Keys() {
  const help = store.fleet.value?.controls.help;
  return help ? <p class="quiet help">{help}</p> : null;
}

/** Cards and robots are two screens; switching between them is part of what is studied. */
function Switching({ state }: { state: StudyState }) {
  const practice = state.steps === null;
  useWatched(store.robots.value.length);
  return (
    <>
      <div class="study-bar">
        <div class="segments" role="group" aria-label="Screen">
          {(["cards", "robots"] as const).map((value) => (
            <button key={value} type="button" class={`button ${screen.value === value ? "chosen" : ""} ${value === "robots" && state.calls && screen.value !== "robots" ? "calls" : ""}`} aria-pressed={screen.value === value} onClick={() => (screen.value = value)}>
              {value === "cards" ? "Cards" : "Robots"} <kbd>{value === "cards" ? "1" : "2"}</kbd>
            </button>
          ))}
        </div>
        <span class="study-call" role="status">
          {state.calls && screen.value === "cards" ? "A robot needs help" : ""}
        </span>
        {practice ? <Go>I know how it works</Go> : null}
      </div>
      <Keyboard />
      {screen.value === "cards" ? state.board ? <Cards board={state.board} /> : null : <Help state={state} />}
    </>
  );
}

/** Robots are watched behind the cards, too: the picture is there at once when somebody goes to them. */
function useWatched(robots: number): void {
  useEffect(() => {
    const gone = Array.from({ length: robots }, (_, robot) =>
      addView({ robot, camera: 0, width: 320, fps: 2, priority: 0, visible: true, canvas: document.createElement("canvas"), stats: signal(noStats()) }),
    );
    return () => gone.forEach((end) => end());
  }, [robots]);
}

function Keyboard() {
  useEffect(() => {
    const down = (event: KeyboardEvent): void => {
      if (event.ctrlKey || event.altKey || event.metaKey || document.querySelector("dialog[open]")) return;
      if (event.code === "Digit1") screen.value = "cards";
      else if (event.code === "Digit2") screen.value = "robots";
    };
    window.addEventListener("keydown", down);
    return () => window.removeEventListener("keydown", down);
  }, []);
  return null;
}

function Help({ state }: { state: StudyState }) {
  const held = store.lease.value;
  if (held) return <Driving key={held.robot} index={held.robot} back={false} />;
  return (
    <div class="black" role="status">
      <p>{state.calls ? "A robot is coming to you…" : "No robot needs help."}</p>
      {state.calls ? null : <p>Go back to the cards.</p>}
    </div>
  );
}

function Panes({ state }: { state: StudyState }) {
  const held = store.lease.value;
  return (
    <>
      {state.steps === null ? (
        <div class="study-bar">
          <Go>I know how it works</Go>
        </div>
      ) : null}
      <div class={held ? "panes panes-driving" : "panes"}>
        {held ? <Driving key={held.robot} index={held.robot} back /> : null}
        <ul class="pane-list">
          {store.robots.value.map((cell, index) =>
            held?.robot === index ? null : (
              <li key={index}>
                <button type="button" class="pane" disabled={held !== null} onClick={() => void takeOver(index)} aria-label={`Take over ${cell.value.name}`}>
                  <Picture robot={index} camera={0} fps={12} priority={1} label={`Picture of ${cell.value.name}`} />
                  <span class="tile-line">
                    <span class="tile-name">{cell.value.name}</span>
                    <Mode look={cell.value.look} />
                  </span>
                </button>
              </li>
            ),
          )}
        </ul>
      </div>
    </>
  );
}

function Driving({ index, back }: { index: number; back: boolean }) {
  const frame = useRef<HTMLDivElement>(null);
  const [stats] = useState(() => signal<ViewStats>(noStats()));
  useEffect(() => frame.current?.focus(), []);
  const robot = store.robots.value[index]?.value;
  const controls = store.fleet.value?.controls;
  if (!robot || !controls) return null;
  const fallen = robot.look === "violated";
  const resetting = robot.mode === ModeNumber.RESETTING;
  return (
    <div class="stage-body stage-mine study-drive">
      <div class="stage-left">
        <View frame={frame} index={index} camera={controls.pointer?.camera ?? 0} stats={stats} mine />
      </div>
      <aside class="panel">
        <div class="actions">
          <p class="driving">
            <strong>{fallen ? "It needs a hard reset" : resetting ? "Resetting" : `You drive ${robot.name}`}</strong>
          </p>
          <div class="action-grid">
            {back ? (
              <button type="button" class="button primary" disabled={resetting} onClick={() => void giveBack(index)}>
                Give back <kbd>{keyLabel(giveBackKey())}</kbd>
              </button>
            ) : null}
            <button type="button" class={`button ${fallen ? "primary" : ""}`} disabled={resetting} onClick={() => askReset(index)}>
              Hard reset… <kbd>{keyLabel(resetKey())}</kbd>
            </button>
          </div>
        </div>
        {fallen || resetting ? null : <Controls controls={controls} />}
      </aside>
    </div>
  );
}

const ENDS = ["very low", "very high"];

/** The NASA-TLX items of the study, for every part. */
function Survey({ state }: { state: StudyState }) {
  const [answers, setAnswers] = useState<Record<string, Record<string, number>>>({});
  const [error, setError] = useState<string | null>(null);
  const [low = 1, high = 5] = state.scale;
  const values = Array.from({ length: high - low + 1 }, (_, k) => low + k);
  const questions = Object.entries(state.questions);
  const complete = state.labels.every((label) => questions.every(([key]) => answers[label]?.[key] !== undefined));
  const submit = async (event: Event): Promise<void> => {
    event.preventDefault();
    try {
      await post("/api/study/answers", { answers });
    } catch (reason) {
      setError(errorText(reason));
    }
  };
  return (
    <form class="study-wide survey" onSubmit={(event) => void submit(event)}>
      <h1>Questions</h1>
      <p>
        From {low}, {ENDS[0]}, to {high}, {ENDS[1]}. Think back to each part.
      </p>
      {questions.map(([key, question]) => (
        <section key={key}>
          <h2>{question}</h2>
          {state.labels.map((label) => (
            <fieldset key={label} class="scale">
              <legend>Part {label}</legend>
              {values.map((value) => (
                <label key={value}>
                  <input
                    type="radio"
                    name={`${key}-${label}`}
                    value={value}
                    checked={answers[label]?.[key] === value}
                    onChange={() => setAnswers({ ...answers, [label]: { ...answers[label], [key]: value } })}
                  />
                  <span>{value}</span>
                </label>
              ))}
            </fieldset>
          ))}
        </section>
      ))}
      <p class="error-line" role="alert">
        {error ?? ""}
      </p>
      <button type="submit" class="button primary big" disabled={!complete}>
        Send
      </button>
    </form>
  );
}
