/** One question at a time, in the browser's own modal dialog. */

import { signal } from "@preact/signals";
import type { ComponentChildren } from "preact";
import { useLayoutEffect, useRef } from "preact/hooks";

interface Question {
  title: string;
  body: ComponentChildren;
  yes: string;
  danger?: boolean;
  /** Enter alone must not do it: the other button has the focus. */
  careful?: boolean;
  onYes: () => void | Promise<unknown>;
}

const question = signal<Question | null>(null);

export function confirmDialog(asked: Question): void {
  question.value = asked;
}

export function Dialogs() {
  const asked = question.value;
  const element = useRef<HTMLDialogElement>(null);
  const before = useRef<Element | null>(null);
  useLayoutEffect(() => {
    const dialog = element.current;
    if (!dialog || !asked) return;
    before.current = document.activeElement;
    dialog.showModal();
    return () => {
      if (dialog.open) dialog.close();
      if (before.current instanceof HTMLElement && before.current.isConnected) before.current.focus();
    };
  }, [asked]);
  if (!asked) return null;
  const close = (): void => {
    question.value = null;
  };
  return (
    <dialog ref={element} class="dialog" aria-labelledby="dialog-title" onClose={close}>
      <h2 id="dialog-title">{asked.title}</h2>
      <div class="dialog-body">{asked.body}</div>
      <div class="dialog-actions">
        <button type="button" class="button" autofocus={asked.careful ?? false} onClick={close}>
          Cancel
        </button>
        <button
          type="button"
          class={`button ${asked.danger ? "danger" : "primary"}`}
          autofocus={!asked.careful}
          onClick={() => {
            close();
            void asked.onYes();
          }}
        >
          {asked.yes}
        </button>
      </div>
    </dialog>
  );
}
