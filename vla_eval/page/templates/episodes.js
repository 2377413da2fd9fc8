"use strict";
// The list of episodes: all data is in the page; only the rows that are shown become elements.
(() => {
  const data = JSON.parse(document.getElementById("episode-data").textContent);
  const at = Object.fromEntries(data.fields.map((name, i) => [name, i]));
  const PAGE = 100;
  const form = document.getElementById("episode-filter");
  const body = document.querySelector("#episode-table tbody");
  const count = document.getElementById("episode-count");
  const beside = document.getElementById("episode-beside");
  const more = document.getElementById("episode-more");
  let found = [], shown = 0, chosen = -1;

  const rowOf = (episode) => data.rows[episode[at.row]];
  const outcomeOf = (episode) => data.outcomes[episode[at.outcome]];
  const itemOf = (episode, field) => {
    const index = episode[at[field]];
    return index === null ? "—" : rowOf(episode).items[index] ?? String(index);
  };
  const errorOf = (episode) => (episode[at.error] === null ? "" : data.errors[episode[at.error]]);
  const cellsOf = (episode) => {
    const row = rowOf(episode);
    const name = row.setting ? `${row.policy} (${row.setting})` : row.policy;
    const step = episode[at.step] === null ? "—" : String(episode[at.step]);
    return [row.task, name, String(row.k), String(episode[at.run]), String(episode[at.seed]), outcomeOf(episode),
      step, itemOf(episode, "target"), itemOf(episode, "chosen")];
  };

  // Task, run and seed are in the title of what stands beside the list.
  const notInTitle = ([, policy, k, , , ...rest]) => [policy, k, ...rest];

  function fill(name, values) {
    const several = [...new Set(values)];
    for (const value of several) form.elements[name].add(new Option(value, value));
    form.elements[name].closest("label").hidden = several.length < (name === "error" ? 1 : 2);
  }
  fill("task", data.rows.map((row) => row.task));
  const isOneTask = new Set(data.rows.map((row) => row.task)).size < 2;
  document.getElementById("episode-table").classList.toggle("one-task", isOneTask);
  fill("policy", data.rows.map((row) => row.policy));
  fill("k", data.rows.map((row) => String(row.k)));
  fill("outcome", data.outcomes);
  fill("error", data.errors.map((text) => text.split(":")[0]));

  function line(episode, cells) {
    const tr = document.createElement("tr");
    for (const text of cells) tr.insertCell().textContent = text;
    tr.className = outcomeOf(episode);
    return tr;
  }
  function show(n) {
    const parts = document.createDocumentFragment();
    for (; shown < Math.min(n, found.length); shown++) {
      const tr = line(found[shown], cellsOf(found[shown]));
      const index = shown;
      tr.addEventListener("click", () => choose(index));
      parts.append(tr);
    }
    body.append(parts);
    more.hidden = shown >= found.length;
  }
  function filter() {
    const wanted = Object.fromEntries(new FormData(form));
    const seed = wanted.seed.trim();
    found = data.episodes.filter((episode) => {
      const row = rowOf(episode);
      return (!wanted.task || row.task === wanted.task) && (!wanted.policy || row.policy === wanted.policy) &&
        (!wanted.k || String(row.k) === wanted.k) && (!wanted.outcome || outcomeOf(episode) === wanted.outcome) &&
        (!wanted.error || errorOf(episode).split(":")[0] === wanted.error) &&
        (!seed || String(episode[at.seed]) === seed);
    });
    body.replaceChildren();
    shown = 0; chosen = -1;
    beside.replaceChildren();
    count.textContent = `${found.length} of ${data.episodes.length} episodes`;
    show(PAGE);
  }
  function choose(index) {
    if (index < 0 || index >= found.length) return;
    show(Math.max(shown, index + 1));
    body.rows[chosen]?.removeAttribute("aria-selected");
    chosen = index;
    body.rows[index].setAttribute("aria-selected", "true");
    body.rows[index].scrollIntoView({ block: "nearest" });
    const one = found[index];
    const same = data.episodes.filter((other) => rowOf(other).task === rowOf(one).task &&
      other[at.seed] === one[at.seed] && other[at.run] === one[at.run]);
    const title = document.createElement("h3");
    title.textContent = `${rowOf(one).task}, run ${one[at.run]}, seed ${one[at.seed]}: all policies`;
    const table = document.createElement("table");
    const headings = table.createTHead().insertRow();
    for (const cell of notInTitle([...document.querySelectorAll("#episode-table th")])) {
      headings.append(cell.cloneNode(true));
    }
    for (const other of same) {
      const tr = line(other, notInTitle(cellsOf(other)));
      if (other === one) tr.setAttribute("aria-selected", "true");
      const last = tr.insertCell();
      last.textContent = errorOf(other);
      for (const kind of ["video", "rrd", "strip"]) {
        if (other[at[kind]] === null) continue;
        const link = document.createElement("a");
        link.href = other[at[kind]];
        link.textContent = kind;
        last.append(link, " ");
      }
      table.append(tr);
    }
    beside.replaceChildren(title, table);
  }
  form.addEventListener("input", filter);
  form.addEventListener("submit", (event) => event.preventDefault());
  more.addEventListener("click", () => show(shown + PAGE));
  document.getElementById("episode-list").addEventListener("keydown", (event) => {
    const step = { ArrowDown: 1, ArrowUp: -1 }[event.key];
    if (step === undefined || event.target.closest("form")) return;
    event.preventDefault();
    choose(chosen + step);
  });
  filter();

  // At rest, a player's controls cover the lower half of the poster.
  for (const video of document.querySelectorAll(".episodes video")) {
    const isNew = () => video.paused && video.currentTime === 0;
    video.tabIndex = 0;
    video.controls = false;
    for (const kind of ["pointerenter", "focus"]) video.addEventListener(kind, () => { video.controls = true; });
    for (const kind of ["pointerleave", "blur"]) video.addEventListener(kind, () => { video.controls = !isNew(); });
  }
})();
