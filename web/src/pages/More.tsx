/** On a small screen: the way to everything that has no place in the bar. */

import { Password, Preferences, Shortcuts, signOut } from "../parts/Shell";
import { canOperate, isAdmin, me } from "../store";

export function More() {
  const places: [string, string, string][] = [
    ["#/operators", "Operators", "what people have done"],
    ["#/replay", "Replay", "interventions again"],
  ];
  if (canOperate.value) places.push(["#/audit", "Audit", "who did what"]);
  if (isAdmin.value) places.push(["#/accounts", "Accounts", "who may sign in"]);
  return (
    <section class="page more">
      <h1 class="head">
        {me.value?.name} <span class="quiet">{me.value?.role}</span>
      </h1>
      <ul class="more-list">
        {places.map(([path, text, say]) => (
          <li key={path}>
            <a href={path}>
              {text} <span class="quiet">{say}</span>
            </a>
          </li>
        ))}
      </ul>
      <Preferences />
      <Shortcuts />
      <Password />
      <button type="button" class="button" onClick={signOut}>
        Sign out
      </button>
    </section>
  );
}
