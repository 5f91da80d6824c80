/** Whether this browser has signed in here: the cookie itself is out of a script's reach. */

const KEY = "tutelage.session";

/** False only where nobody can be signed in. */
export function maybe(): boolean {
  try {
    return localStorage.getItem(KEY) !== null;
  } catch {
    return true;
  }
}

export function remember(signedIn: boolean): void {
  try {
    if (signedIn) localStorage.setItem(KEY, "1");
    else localStorage.removeItem(KEY);
  } catch {
    // without storage the server is asked each time
  }
}
