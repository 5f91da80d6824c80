/** Emergency stop: by both ways at once, the live socket and HTTP, and whichever arrives first acts. */

import { errorText, post } from "./api";
import { send, spoken } from "./live";
import * as store from "./store";

let refs = 0;

export async function emergencyStop(robot: number | null): Promise<void> {
  const what = robot === null ? "All robots" : store.robotName(robot);
  spoken(`Emergency stop: ${what}`);
  const said = send({ type: "estop", robot, ref: `stop${++refs}` });
  try {
    await post("/api/estop", { robot });
    store.note(`Emergency stop: ${what}.`, "error");
  } catch (error) {
    if (said) store.note(`Emergency stop sent: ${what}.`, "error");
    else store.note(`EMERGENCY STOP NOT SENT (${errorText(error)}) Use the robot's own switch.`, "error");
  }
}

export async function clearStop(robot: number | null): Promise<void> {
  try {
    await post("/api/estop/clear", { robot });
    store.note(`Stop cleared: ${robot === null ? "all robots" : store.robotName(robot)}.`);
  } catch (error) {
    store.note(`The stop was not cleared: ${errorText(error)}`, "error");
  }
}
