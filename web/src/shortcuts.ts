/** Keys that work everywhere. Esc is for danger: once stops the robot that one drives, twice stops all. */

import { giveBack, takeOver, decline } from "./live";
import { giveBackKey, isDriveKey, resetKey } from "./drive";
import { askReset } from "./pages/Stage";
import { emergencyStop } from "./stop";
import * as store from "./store";
import { Mode } from "./modes";

const TWICE = 800; // ms
let lastEscape = -Infinity;

function escape(event: KeyboardEvent): void {
  if (event.repeat || !store.canOperate.value) return;
  const at = performance.now();
  if (at - lastEscape < TWICE) {
    lastEscape = -Infinity;
    void emergencyStop(null);
    return;
  }
  lastEscape = at;
  if (document.querySelector("dialog[open]")) return; // once closes it; twice still stops all
  const driven = store.lease.value?.robot;
  if (driven !== undefined) void emergencyStop(driven);
}

function letter(event: KeyboardEvent): void {
  if (event.repeat || event.ctrlKey || event.metaKey || event.altKey || isDriveKey(event.code)) return;
  if ((event.target as HTMLElement | null)?.closest?.("input:not([type=range]):not([type=checkbox]):not([type=radio]), textarea, select, dialog")) return;
  const first = store.offers.value.keys().next().value;
  // In the study, going to the robots accepts, and the algorithm gives them back.
  if (store.study.value?.interface === "game" && event.code !== resetKey()) return;
  const driven = store.lease.value?.robot;
  if (event.code === "KeyA" && first !== undefined && driven === undefined) void takeOver(first);
  else if (event.code === "KeyD" && first !== undefined && driven === undefined) void decline(first);
  else if (event.code === giveBackKey() && driven !== undefined) void giveBack(driven);
  else if (event.code === resetKey() && driven !== undefined && store.robots.value[driven]?.value.mode !== Mode.RESETTING) askReset(driven);
  else return;
  event.preventDefault();
}

window.addEventListener("keydown", (event) => {
  if (!store.me.value) return;
  if (event.key === "Escape") escape(event);
  else letter(event);
});
