// Serves these pages, and passes /play/ and WebSockets on to a game server: one origin for both, as a browser wants it.
//
//     npm ci && node serve.mjs [http://127.0.0.1:8765] [port]
//
// Any web server with a reverse proxy does the same.

import { createServer, request } from "node:http";
import { readFile } from "node:fs/promises";
import { connect } from "node:net";
import { extname, join, normalize } from "node:path";
import { fileURLToPath } from "node:url";

const [game = "http://127.0.0.1:8765", port = 8000] = process.argv.slice(2);
const FOLDER = fileURLToPath(new URL(".", import.meta.url));
const TYPES = { ".html": "text/html; charset=utf-8", ".js": "text/javascript; charset=utf-8" };
const { hostname, port: to = 80, host } = new URL(game);

const server = createServer(async (asked, answer) => {
  const { pathname } = new URL(asked.url, "http://here");
  if (pathname.startsWith("/play/")) {
    request({ hostname, port: to, path: asked.url, headers: { host } }, given => {
      answer.writeHead(given.statusCode, given.headers);
      given.pipe(answer);
    }).on("error", () => answer.writeHead(502).end()).end();
    return;
  }
  const path = normalize(join(FOLDER, pathname)), type = TYPES[extname(path)];
  const data = path.startsWith(FOLDER) && type ? await readFile(path).catch(() => null) : null;
  answer.writeHead(data ? 200 : 404, { "Content-Type": type ?? "text/plain" }).end(data ?? "no such file");
});

server.on("upgrade", ({ url, headers }, socket) => {
  const line = connect(to, hostname, () => {
    const own = { ...headers, host, origin: game };
    const head = Object.entries(own).map(([name, value]) => `${name}: ${value}\r\n`).join("");
    line.write(`GET ${url} HTTP/1.1\r\n${head}\r\n`);
    line.pipe(socket).pipe(line);
  });
  for (const end of [line, socket]) end.on("error", () => [line.destroy(), socket.destroy()]);
});

server.listen(Number(port), "127.0.0.1", () => {
  const address = `http://127.0.0.1:${server.address().port}`;
  console.log(`${address}/canvas.html and ${address}/three.html`);
});
