/** The operators' console. */

import { effect, untracked } from "@preact/signals";
import { render } from "preact";
import "./styles/tokens.css";
import "./styles/base.css";
import "./styles/shell.css";
import "./styles/operate.css";
import "./styles/pages.css";
import "./styles/study.css";
import { get, whenSignedOut } from "./api";
import { unlock } from "./chime";
import { followLease } from "./drive";
import { connect, disconnect, retryNow } from "./live";
import { Accounts } from "./pages/Accounts";
import { Audit } from "./pages/Audit";
import { Charts } from "./pages/Charts";
import { Login } from "./pages/Login";
import { More } from "./pages/More";
import { Operate } from "./pages/Operate";
import { Operators } from "./pages/Operators";
import { Study } from "./pages/Study";
import { Replay } from "./pages/Replay";
import { Dialogs } from "./parts/Dialog";
import { Notes } from "./parts/Notes";
import { Shell } from "./parts/Shell";
import type { Me } from "./protocol";
import { go, route } from "./route";
import "./shortcuts";
import * as store from "./store";
import "./theme";
import * as session from "./session";
import { startVideo, stopVideo } from "./video";

function Page() {
  switch (route.value.page) {
    case "charts":
      return <Charts />;
    case "operators":
      return <Operators />;
    case "replay":
      return <Replay />;
    case "audit":
      return <Audit />;
    case "accounts":
      return <Accounts />;
    case "more":
      return <More />;
    default:
      return <Operate />;
  }
}

function App() {
  const person = store.me.value;
  if (person === undefined) return <p class="nobody">One moment…</p>;
  if (person === null) return <Login setup={route.value.page === "setup" ? route.value.id : null} />;
  if (store.study.value && store.canOperate.value) return <Study state={store.study.value} />;
  return (
    <Shell>
      <Page />
    </Shell>
  );
}

function Root() {
  return (
    <>
      <App />
      <Notes />
      <Dialogs />
      <p id="spoken" class="sr" aria-live="assertive" />
    </>
  );
}

whenSignedOut(() => {
  if (store.me.value) store.note("The session is over. Sign in again.", "warning");
  store.me.value = null;
});

// The sockets live as long as somebody is signed in.
effect(() => {
  const name = store.me.value?.name;
  untracked(() => {
    if (name) {
      connect();
      startVideo();
    } else {
      disconnect();
      stopVideo();
    }
  });
});
followLease();

// Whoever gets a robot looks at it; whoever is done with one looks at the fleet again.
const DONE = new Set(["given_back", "handed_over", "completed"]);
let drove: number | null = null;
effect(() => {
  const robot = store.lease.value?.robot ?? null;
  untracked(() => {
    if (robot === drove || store.study.value) return;
    if (robot !== null) go(`/robot/${robot}`);
    else if (drove !== null && store.connection.value.kind === "open" && route.value.page === "robot" && route.value.id === String(drove)) {
      if (DONE.has(store.lastEnd.value)) go("/");
    }
    drove = robot;
  });
});

// The title says how many ask, and blinks in a hidden tab.
let blink = false;
function title(): void {
  const asking = store.offers.value.size;
  blink = asking > 0 && document.hidden ? !blink : false;
  const task = store.fleet.value?.task;
  const name = task ? `${task} · Tutelage` : "Tutelage";
  document.title = asking ? `${blink ? "●" : "○"} ${asking} ${asking === 1 ? "request" : "requests"} · ${name}` : name;
}

window.setInterval(() => {
  store.now.value = Date.now() / 1000;
  const stale = [...store.offers.value].filter(([, offer]) => offer.until < store.now.value);
  if (stale.length) {
    const offers = new Map(store.offers.value);
    for (const [robot] of stale) offers.delete(robot);
    store.offers.value = offers;
  }
}, 250);
window.setInterval(() => {
  store.advanceHistory();
  title();
}, 1000);
effect(() => {
  void store.offers.value;
  title();
});
window.addEventListener("online", retryNow);
window.addEventListener("pointerdown", unlock, { once: true });
window.addEventListener("keydown", unlock, { once: true });

// Whether somebody is signed in is asked only where it can be so: a refusal would be an error in the browser's console.
if (session.maybe()) {
  void get<Me>("/api/me", true).then(
    (person) => (store.me.value = person),
    () => (store.me.value = null),
  );
} else {
  store.me.value = null;
}
effect(() => {
  const person = store.me.value;
  if (person !== undefined) session.remember(person !== null);
});

render(<Root />, document.getElementById("app") as HTMLElement);
