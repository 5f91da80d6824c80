/** Requests by priority. Those offered to this person come first and can be accepted with one key. */

import { useComputed } from "@preact/signals";
import { clock, plural } from "../format";
import { decline, takeOver } from "../live";
import { reasonText, type Look, LOOK_TEXT } from "../modes";
import { Glyph } from "../parts/Glyph";
import type { QueueRow } from "../protocol";
import { asked, canOperate, clockSync, lease, me, now, offers, queue, robotName, robots, snapshot, tally } from "../store";

export function Queue() {
  const mine = [...offers.value.entries()];
  const others = queue.value.filter((row) => !offers.value.has(row.robot));
  return (
    <section class="queue" aria-label="Requests">
      <h1 class="head">
        Requests <span class="count num">{queue.value.length || ""}</span>
      </h1>
      <div class="offers">
        {mine.map(([robot, offer], k) => (
          <Offer key={robot} robot={robot} reason={offer.reason} until={offer.until} seconds={offer.seconds} first={k === 0} />
        ))}
      </div>
      {others.length ? (
        <ol class="waiting">
          {others.map((row) => (
            <Row key={row.robot} row={row} />
          ))}
        </ol>
      ) : null}
      {!mine.length && !others.length ? <Nobody /> : null}
      <Tally />
    </section>
  );
}

function since(robot: number): number | null {
  const row = queue.value.find((one) => one.robot === robot);
  return row ? row.since : null;
}

function Waited({ from }: { from: number | null }) {
  const text = useComputed(() => (from === null ? "" : clock(now.value + clockSync.offset - from)));
  return <span class="num waited">{text}</span>;
}

function Offer({ robot, reason, until, seconds, first }: { robot: number; reason: string; until: number; seconds: number; first: boolean }) {
  const left = Math.max(0, until - now.value);
  const taken = asked.value.has(robot);
  return (
    <article class={`offer ${reason === "violated" ? "offer-urgent" : ""}`} aria-label={`Offer: ${robotName(robot)}`}>
      <div class="offer-line">
        <a class="offer-name" href={`#/robot/${robot}`}>
          {robotName(robot)}
        </a>
        <Waited from={since(robot)} />
      </div>
      <p class="offer-reason">
        <Glyph look={reason === "violated" ? "violated" : "asking"} />
        {reasonText(reason)}
      </p>
      <progress class="countdown" max={seconds} value={left} aria-label="Time to answer" />
      <div class="offer-actions">
        <button type="button" class="button primary" disabled={taken || lease.value !== null} onClick={() => void takeOver(robot)} aria-keyshortcuts={first ? "a" : undefined}>
          {taken ? "Accepting…" : "Accept"} {first ? <kbd>A</kbd> : null}
        </button>
        <button type="button" class="button" disabled={taken} onClick={() => void decline(robot)} aria-keyshortcuts={first ? "d" : undefined}>
          Decline {first ? <kbd>D</kbd> : null}
        </button>
        <span class="num quiet" aria-hidden="true">
          {Math.ceil(left)} s
        </span>
      </div>
    </article>
  );
}

function Row({ row }: { row: QueueRow }) {
  const robot = robots.value[row.robot]?.value;
  const look: Look = row.reason === "violated" ? "violated" : (robot?.look ?? "asking");
  return (
    <li class="waiting-row">
      <a href={`#/robot/${row.robot}`}>
        <Glyph look={look} />
        <span class="waiting-name">{robotName(row.robot)}</span>
        <Waited from={row.since} />
        <span class="waiting-reason">{reasonText(row.reason)}</span>
        <span class="waiting-to">{row.offered_to ? (row.offered_to === me.value?.name ? "offered to you" : `offered to ${row.offered_to}`) : "nobody free"}</span>
      </a>
    </li>
  );
}

/** Why nobody asks: all is well, or nobody can. */
function Nobody() {
  const { offline, stopped } = tally.value;
  const count = robots.value.length;
  const silent = !snapshot.value ? "Waiting for the fleet…" : offline === count ? "No robot can be reached." : offline + stopped === count ? "No robot asks: they are stopped." : null;
  return (
    <p class="nobody">
      {silent ?? "No robot needs help."}
      {canOperate.value && !silent ? <span class="quiet"> A chime will call you.</span> : null}
    </p>
  );
}

const ORDER: Look[] = ["auto", "asking", "switching", "driven", "held", "violated", "resetting", "offline", "stopped"];

function Tally() {
  const counts = tally.value;
  const version = snapshot.value?.policy_version;
  return (
    <div class="tally">
      <h2 class="sub">Fleet</h2>
      <ul>
        {ORDER.filter((look) => counts[look] || look === "auto").map((look) => (
          <li key={look}>
            <Glyph look={look} />
            <span>{LOOK_TEXT[look]}</span>
            <span class="num">{counts[look]}</span>
          </li>
        ))}
      </ul>
      <p class="quiet">
        {plural(robots.value.length, "robot")}
        {version !== undefined ? (
          <>
            {" · policy "}
            <span data-testid="policy-version" class="num">
              {version}
            </span>
          </>
        ) : null}
      </p>
    </div>
  );
}
