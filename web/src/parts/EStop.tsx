/** The emergency stop. Stopping asks nothing; going on does. */

import { anyStopped, canOperate, snapshot } from "../store";
import { clearStop, emergencyStop } from "../stop";
import { confirmDialog } from "./Dialog";
import { plural } from "../format";

export function askToClear(robot: number | null, name: string): void {
  confirmDialog({
    title: robot === null ? "Let all stopped robots go on?" : `Let ${name} go on?`,
    body: <p>Robots may move at once. Make sure that nobody is near them.</p>,
    yes: "Clear the stop",
    danger: true,
    careful: true,
    onYes: () => clearStop(robot),
  });
}

let pressed = -Infinity;

export function EStop() {
  if (!canOperate.value) return null;
  const stopped = snapshot.value?.stopped.filter(Boolean).length ?? 0;
  return (
    <div class="estop-group">
      {anyStopped.value ? (
        <button type="button" class="button clear-stop" onClick={() => askToClear(null, "")}>
          Clear <span class="wide">stop of {plural(stopped, "robot")}</span>
        </button>
      ) : null}
      <button
        type="button"
        class="estop"
        // At once when it is pressed, not when it is let go; the click of a key has no press before it.
        onPointerDown={(event) => {
          if (event.button !== 0) return;
          pressed = event.timeStamp;
          void emergencyStop(null);
        }}
        onClick={(event) => {
          if (event.timeStamp - pressed > 2000) void emergencyStop(null);
        }}
        title="Stops every robot at once (Esc twice)"
        aria-label="Emergency stop: all robots"
        aria-keyshortcuts="Escape Escape"
      >
        <svg viewBox="0 0 16 16" aria-hidden="true">
          <path d="M5 .8h6L15.2 5v6L11 15.2H5L.8 11V5Z" fill="currentColor" />
        </svg>
        <span>
          <span class="wide">Emergency </span>stop
        </span>
      </button>
    </div>
  );
}
