// Runs a Python program in Pyodide, in Node.js. Reads from standard input, as JSON:
//
//     pyodide   folder of the npm package
//     archives  paths of zip archives and wheels, which are unpacked to /site
//     files     paths of further files, by their path within Pyodide
//     program   Python source, whose last expression is a text
//
// Prints the text. The program may call `js.cpu`, which returns the CPU time so far in seconds.

import { readFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const { pyodide, archives, files, program } = JSON.parse(readFileSync(0, "utf-8"));
globalThis.cpu = () => process.cpuUsage().user / 1e6;
const read = path => new Uint8Array(readFileSync(path));
try {
  const { loadPyodide } = await import(pathToFileURL(`${pyodide}/pyodide.mjs`).href);
  const python = await loadPyodide({ indexURL: `${pyodide}/` });
  for (const path of archives) python.unpackArchive(read(path), "zip", { extractDir: "/site" });
  for (const [name, path] of Object.entries(files)) {
    python.FS.mkdirTree(name.slice(0, name.lastIndexOf("/")));
    python.FS.writeFile(name, read(path));
  }
  python.runPython('import sys; sys.path.insert(0, "/site")');
  console.log(python.runPython(program));
} catch (error) {
  console.error(String(error.message ?? error).slice(-3000)); // without the source line of a minified file
  process.exitCode = 1;
}
