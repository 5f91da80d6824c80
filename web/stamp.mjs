// Writes into the built page what it was built from, so that a test can tell without Node whether it is up to date:
// the SHA-256 of every source, over "name NUL length NUL bytes" in the order of names.
import { createHash } from "node:crypto";
import { readdirSync, readFileSync, statSync, writeFileSync } from "node:fs";
import { join, posix } from "node:path";

const FILES = ["index.html", "package.json", "package-lock.json", "tsconfig.json", "vite.config.ts"];
const FOLDERS = ["public", "src"];

function below(folder) {
  return readdirSync(folder).flatMap((name) => {
    const path = posix.join(folder, name);
    return statSync(path).isDirectory() ? below(path) : [path];
  });
}

const names = [...FILES, ...FOLDERS.flatMap(below)].sort((a, b) => (a < b ? -1 : 1));
const hash = createHash("sha256");
for (const name of names) {
  const content = readFileSync(name);
  hash.update(`${name}\0${content.length}\0`);
  hash.update(content);
}
const out = join("..", "src", "tutelage", "console", "static");

// What the page contains of others, with their licences.
const parts = ["preact", "@preact/signals", "@preact/signals-core"].map((name) => {
  const folder = join("node_modules", name);
  const { version, license } = JSON.parse(readFileSync(join(folder, "package.json"), "utf8"));
  return `${name} ${version} (${license})\n\n${readFileSync(join(folder, "LICENSE"), "utf8").trim()}\n`;
});
writeFileSync(join(out, "licenses.txt"), parts.join(`\n${"-".repeat(80)}\n\n`));

const built = {};
for (const name of ["index.html", "icon.svg", "licenses.txt", ...readdirSync(join(out, "assets")).map((file) => `assets/${file}`)].sort()) {
  built[name] = createHash("sha256").update(readFileSync(join(out, name))).digest("hex");
}
writeFileSync(join(out, "built-from.json"), JSON.stringify({ sources: hash.digest("hex"), built }, null, 2) + "\n");
