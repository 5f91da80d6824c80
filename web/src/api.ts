/** HTTP: JSON in, JSON out; whatever goes wrong is an `ApiError` with a line to show. */

export class ApiError extends Error {
  constructor(
    readonly status: number,
    message: string,
    readonly retryAfter: number | null = null,
  ) {
    super(message);
  }
}

let onSignedOut: () => void = () => undefined;

/** What to do when the server says that the session is over. */
export function whenSignedOut(callback: () => void): void {
  onSignedOut = callback;
}

async function request<T>(method: string, path: string, body?: unknown, quiet = false): Promise<T> {
  const headers: Record<string, string> = { Accept: "application/json" };
  if (method !== "GET") headers["X-Tutelage"] = "1";
  if (body !== undefined) headers["Content-Type"] = "application/json";
  let answer: Response;
  try {
    answer = await fetch(path, {
      method,
      headers,
      credentials: "same-origin",
      cache: "no-store",
      ...(body === undefined ? {} : { body: JSON.stringify(body) }),
    });
  } catch {
    throw new ApiError(0, "The server cannot be reached.");
  }
  const text = await answer.text();
  let data: unknown = null;
  try {
    data = text ? JSON.parse(text) : null;
  } catch {
    if (answer.ok) throw new ApiError(answer.status, "The server's answer cannot be read.");
  }
  if (!answer.ok) {
    const fields = (data ?? {}) as { error?: unknown; text?: unknown; detail?: unknown; retry_after?: unknown };
    const said = [fields.error, fields.text, fields.detail].find((value) => typeof value === "string" && value);
    if (answer.status === 401 && !quiet) onSignedOut();
    throw new ApiError(
      answer.status,
      typeof said === "string" ? said : `The server answered ${answer.status}.`,
      typeof fields.retry_after === "number" ? fields.retry_after : null,
    );
  }
  return data as T;
}

export const get = <T>(path: string, quiet = false): Promise<T> => request<T>("GET", path, undefined, quiet);
export const post = <T>(path: string, body: unknown = {}, quiet = false): Promise<T> => request<T>("POST", path, body, quiet);
export const patch = <T>(path: string, body: unknown): Promise<T> => request<T>("PATCH", path, body);
export const remove = <T>(path: string): Promise<T> => request<T>("DELETE", path);

/** A line for people about anything that was thrown. */
export function errorText(error: unknown): string {
  return error instanceof Error ? error.message : String(error);
}
