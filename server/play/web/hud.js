// The text over the picture: the round, the scores, the figures of the network, and recent events.

const element = id => document.getElementById(id);
const ms = seconds => `${(seconds * 1000).toFixed(0)} ms`, rate = bytes => `${(bytes / 1000).toFixed(1)} kB/s`;
const TOASTS = 4, SCORES = 12, FADE_MS = 4000;
const VERDICTS = { matched: "#78d68c", "late inputs": "#f5be3c", others: "#78c8ff", diverging: "#f05046" };

function cells(row, ...texts) {
  texts.forEach((text, i) => {
    row.cells[i] ?? row.insertCell();
    if (row.cells[i].textContent !== text) row.cells[i].textContent = text;
  });
}

function fill(body, rows, draw) { // a table's rows, of which as many are kept as possible
  while (body.rows.length > rows.length) body.deleteRow(-1);
  rows.forEach((row, i) => draw(body.rows[i] ?? body.insertRow(), row));
}

export class Hud {
  constructor(client) {
    this._client = client;
    this._lately = []; // times at which snapshots came
    this._age = 0;
    for (const id of ["top", "network", "keys"]) element(id).hidden = false;
    element("fold").onclick = () => this._fold(!element("network").classList.contains("folded"));
    this._fold(innerWidth < 700 || innerHeight < 480);
  }

  _fold(folded) {
    element("network").classList.toggle("folded", folded);
    element("fold").setAttribute("aria-expanded", String(!folded));
  }

  // Shows a line of text for some seconds.
  say(text) {
    const toast = Object.assign(document.createElement("p"), { textContent: text });
    element("toasts").prepend(toast);
    while (element("toasts").children.length > TOASTS) element("toasts").lastChild.remove();
    setTimeout(() => toast.remove(), FADE_MS);
  }

  // Counts a snapshot if the newest one is younger than in the frame before.
  count(now) {
    const { snapshot_age_s: age } = this._client.stats;
    if (age < this._age) this._lately.push(now);
    this._age = age;
    while (this._lately[0] < now - 1000) this._lately.shift();
  }

  // Shows everything; a few times per second is enough.
  show(figures, view) {
    const { _client: client } = this, { shared, stats, scene } = client;
    const points = shared.points && typeof shared.points === "object"
      ? Object.entries(shared.points).map(([team, count]) => `    ${team} ${count}`).join("") : "";
    element("title").textContent = (client.world || client.game.title) + points;
    const left = Number.isInteger(shared.ends) ? Math.max(shared.ends - view.tick, 0) / scene.tick_rate : null;
    element("clock").textContent = left === null ? ""
      : `${Math.floor(left / 60)}:${String(Math.floor(left % 60)).padStart(2, "0")}`;
    const rows = [
      ["round trip", ms(stats.rtt_s)], ["input lead", ms(stats.lead_s)], ["snapshots", `${this._lately.length} /s`],
      ["snapshot age", ms(stats.snapshot_age_s)], ["up", rate(stats.bytes_up_per_s)], ["down", rate(stats.bytes_down_per_s)],
      ["late inputs", `${(100 * stats.late_share).toFixed(2)} %`], ["corrections / min", String(stats.corrections_lately)],
      ["client per frame", `${(stats.frame_s * 1000).toFixed(1)} ms`], ["kernel", client.started.kernel],
    ];
    if (stats.reconnects) rows.push(["reconnects", String(stats.reconnects)]);
    if (stats.divergences) rows.push(["DIVERGED", String(stats.divergences)]);
    fill(element("figures"), rows, (row, texts) => cells(row, ...texts));
    const scores = figures.filter(({ attributes }) => Number.isInteger(attributes.score))
      .sort((a, b) => b.attributes.score - a.attributes.score || a.entity - b.entity).slice(0, SCORES);
    element("score").hidden = scores.length === 0;
    fill(element("scores"), scores, (row, { attributes, tone, it }) => {
      cells(row, String(attributes.name || "?"), String(attributes.score));
      if (!row.cells[0].querySelector("i")) row.cells[0].prepend(document.createElement("i"));
      row.querySelector("i").style.background = `rgb(${tone})`;
      row.className = it ? "it" : "";
    });
  }

  // Shows the keys of the game.
  keys(names, more) {
    const all = [["WASD / arrows", "walk"], ...Object.entries(names).map(([button, name]) => [name, button]), ...more];
    element("keys").replaceChildren(...all.map(([key, meaning]) => {
      const part = document.createElement("span"), name = Object.assign(document.createElement("b"), { textContent: key });
      part.append(name, `: ${meaning}`);
      return part;
    }));
  }

  // Shows or hides the diagnosis for developers.
  async diagnose() {
    const panel = element("diagnosis");
    panel.hidden = !panel.hidden;
    while (!panel.hidden && !this._client.closed) {
      const { verdict, reason, advice, warnings } = await this._client.verdict();
      panel.replaceChildren(...[`${verdict}: ${reason}`, advice, ...warnings].filter(Boolean).map((text, i) => {
        const line = Object.assign(document.createElement("p"), { textContent: text });
        if (i === 0) line.style.color = VERDICTS[verdict] ?? "#78c8ff";
        return line;
      }));
      await new Promise(done => setTimeout(done, 500));
    }
  }
}

// Returns an event of the game as a sentence; one that the page does not know is shown with its name and data.
export function sentence(name, data, view) {
  const called = entity => {
    const figure = [view.me, ...view.others].find(each => each?.entity === entity);
    return figure ? String(figure.attributes.name ?? `#${entity}`) : "a player";
  };
  const table = data && typeof data === "object" && !Array.isArray(data) ? data : null;
  if (name === "said" && table) return `${called(table.by)}: ${table.text}`;
  if (name === "tagged" && table) return `${called(table.by)} tagged ${called(table.who)}`;
  if (name === "out" && table) return `${called(table.by)} puts ${called(table.who)} out`;
  if (name === "round" && table)
    return `${typeof table.winner === "string" ? table.winner : called(table.winner)} wins the round`;
  if (!table) return `${name} ${data ?? ""}`;
  return name + Object.entries(table).map(([key, value]) =>
    `  ${key} ${key === "by" || key === "who" ? called(value) : JSON.stringify(value)}`).join("");
}
