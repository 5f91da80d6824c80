/** The operators' page: who needs help on the left, the robots or the one that is looked at on the right. */

import { route } from "../route";
import { Queue } from "./Queue";
import { Stage } from "./Stage";
import { Wall } from "./Wall";

export function Operate() {
  const { page, id } = route.value;
  const robot = page === "robot" && id !== null ? Number(id) : null;
  return (
    <div class={`operate ${robot !== null ? "with-stage" : ""} ${page === "queue" ? "queue-first" : ""}`}>
      <Queue />
      {robot !== null && Number.isInteger(robot) ? <Stage key={robot} index={robot} /> : <Wall />}
    </div>
  );
}
