/** Who may sign in, and as what. For administrators. */

import { useState } from "preact/hooks";
import { errorText, patch, post, remove } from "../api";
import { moment } from "../format";
import { confirmDialog } from "../parts/Dialog";
import { useLoad } from "../parts/load";
import type { Account, Role } from "../protocol";
import { isAdmin, me, note } from "../store";

const ROLES: [Role, string][] = [
  ["viewer", "watches"],
  ["operator", "watches, drives and stops robots"],
  ["admin", "also manages accounts"],
];

export function Accounts() {
  const { data, error, reload } = useLoad<{ rows: Account[] }>(isAdmin.value ? "/api/accounts" : null);
  if (!isAdmin.value) {
    return (
      <section class="page">
        <p class="nobody">Only administrators see accounts.</p>
      </section>
    );
  }
  const act = async (what: Promise<unknown>, done: string): Promise<boolean> => {
    try {
      await what;
      note(done);
      reload();
      return true;
    } catch (reason) {
      note(errorText(reason), "error");
      return false;
    }
  };
  return (
    <section class="page narrow">
      <h1 class="head">Accounts</h1>
      {error ? <p class="error-line">{error}</p> : null}
      {data ? (
        <div class="table-scroll">
          <table>
            <thead>
              <tr>
                <th scope="col">Name</th>
                <th scope="col">Role</th>
                <th scope="col">Created</th>
                <th scope="col">Last sign-in</th>
                <th scope="col">
                  <span class="sr">Change</span>
                </th>
              </tr>
            </thead>
            <tbody>
              {data.rows.map((account) => (
                <Row key={account.name} account={account} act={act} />
              ))}
            </tbody>
          </table>
        </div>
      ) : null}
      <NewAccount act={act} />
    </section>
  );
}

type Act = (what: Promise<unknown>, done: string) => Promise<boolean>;

function Row({ account, act }: { account: Account; act: Act }) {
  const [password, setPassword] = useState<string | null>(null);
  const path = `/api/accounts/${encodeURIComponent(account.name)}`;
  const own = account.name === me.value?.name;
  return (
    <tr>
      <th scope="row">
        {account.name}
        {own ? <span class="quiet"> you</span> : null}
      </th>
      <td>
        <select
          aria-label={`Role of ${account.name}`}
          value={account.role}
          disabled={own}
          onChange={(event) => void act(patch(path, { role: event.currentTarget.value }), `${account.name} is ${event.currentTarget.value} now.`)}
        >
          {ROLES.map(([role]) => (
            <option key={role} value={role}>
              {role}
            </option>
          ))}
        </select>
      </td>
      <td class="num">{moment(account.created)}</td>
      <td class="num">{moment(account.last_login)}</td>
      <td class="row-actions">
        {password === null ? (
          <>
            <button type="button" class="button" onClick={() => setPassword("")}>
              Password…
            </button>
            <button
              type="button"
              class="button"
              disabled={own}
              onClick={() =>
                confirmDialog({
                  title: `Delete ${account.name}?`,
                  body: <p>The account and its sessions end at once. What they did stays in the record.</p>,
                  yes: "Delete",
                  danger: true,
                  onYes: () => act(remove(path), `${account.name} is deleted.`),
                })
              }
            >
              Delete…
            </button>
          </>
        ) : (
          <form
            class="inline"
            onSubmit={(event) => {
              event.preventDefault();
              void act(patch(path, { password }), `${account.name} has a new password.`).then((ok) => ok && setPassword(null));
            }}
          >
            <input type="password" autocomplete="new-password" aria-label={`New password of ${account.name}`} placeholder="New password" value={password} onInput={(event) => setPassword(event.currentTarget.value)} />
            <button type="submit" class="button primary" disabled={!password}>
              Set
            </button>
            <button type="button" class="button" onClick={() => setPassword(null)}>
              Cancel
            </button>
          </form>
        )}
      </td>
    </tr>
  );
}

function NewAccount({ act }: { act: Act }) {
  const [name, setName] = useState("");
  const [password, setPassword] = useState("");
  const [role, setRole] = useState<Role>("operator");
  return (
    <form
      class="new-account"
      onSubmit={(event) => {
        event.preventDefault();
        void act(post("/api/accounts", { name, role, password }), `${name} can sign in now.`).then((ok) => {
          if (!ok) return;
          setName("");
          setPassword("");
        });
      }}
    >
      <h2 class="sub">New account</h2>
      <label class="field-label">
        Name
        <input type="text" required maxLength={64} autocomplete="off" value={name} onInput={(event) => setName(event.currentTarget.value)} />
      </label>
      <label class="field-label">
        Password
        <input type="password" required autocomplete="new-password" value={password} onInput={(event) => setPassword(event.currentTarget.value)} />
      </label>
      <label class="field-label">
        Role
        <select value={role} onChange={(event) => setRole(event.currentTarget.value as Role)}>
          {ROLES.map(([value, text]) => (
            <option key={value} value={value}>
              {value}: {text}
            </option>
          ))}
        </select>
      </label>
      <button type="submit" class="button primary" disabled={!name || !password}>
        Add
      </button>
    </form>
  );
}
