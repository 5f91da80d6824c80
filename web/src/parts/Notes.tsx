/** What happened, in the corner: fades by itself unless it is an error. */

import { useEffect } from "preact/hooks";
import { dropNote, notes, type Note } from "../store";

function One({ note }: { note: Note }) {
  useEffect(() => {
    const seconds = note.level === "error" ? 20 : note.level === "warning" ? 10 : 6;
    const timer = window.setTimeout(() => dropNote(note.id), seconds * 1000);
    return () => window.clearTimeout(timer);
  }, [note.id]);
  return (
    <li class={`note note-${note.level}`}>
      <span>{note.text}</span>
      <button type="button" class="icon-button" aria-label="Dismiss" onClick={() => dropNote(note.id)}>
        ×
      </button>
    </li>
  );
}

export function Notes() {
  return (
    <ul class="notes" role="status" aria-live="polite">
      {notes.value.map((note) => (
        <One key={note.id} note={note} />
      ))}
    </ul>
  );
}
