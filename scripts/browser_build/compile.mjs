// Compiles the modules of a zip archive with the Python of a Pyodide: `node compile.mjs PYODIDE IN OUT`.
// A source a.py becomes a.pyc in the same place, without docstrings, which is not checked against a source when it is imported.

import { readFileSync, writeFileSync } from "node:fs";
import { pathToFileURL } from "node:url";

const [folder, given, made] = process.argv.slice(2);
const { loadPyodide } = await import(new URL("pyodide.mjs", pathToFileURL(`${folder}/`)));
const python = await loadPyodide({ indexURL: `${folder}/` });
python.FS.writeFile("/in.zip", new Uint8Array(readFileSync(given)));
python.runPython(`
import importlib.util, importlib._bootstrap_external as external, zipfile

with zipfile.ZipFile("/in.zip") as given, zipfile.ZipFile("/out.zip", "w") as made:
    for entry in given.infolist():
        data, name = given.read(entry), entry.filename
        if name.endswith(".py"):
            code = compile(data, f"/lib/python314.zip/{name}", "exec", dont_inherit=True, optimize=2)
            data, name = external._code_to_hash_pyc(code, importlib.util.source_hash(data), False), f"{name}c"
        made.writestr(zipfile.ZipInfo(name, entry.date_time), data)
`);
writeFileSync(made, python.FS.readFile("/out.zip"));
