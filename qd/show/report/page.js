"use strict";
const close = (row) => {
  if (row.getAttribute("aria-expanded") !== "true") return;
  row.setAttribute("aria-expanded", "false");
  row.nextElementSibling.remove();
};

const open = (row) => {
  const image = document.createElement("img");
  [image.src, image.alt] = [row.dataset.opens, row.dataset.shows];
  const words = document.createElement("p");
  words.textContent = row.dataset.shows;
  const cell = document.createElement("td");
  [cell.className, cell.colSpan] = ["opened", row.cells.length];
  cell.append(words, image);
  const below = document.createElement("tr");
  below.append(cell);
  row.after(below);
  row.setAttribute("aria-expanded", "true");
};

for (const row of document.querySelectorAll("tr[data-opens]")) {
  const turn = () => (row.getAttribute("aria-expanded") === "true" ? close : open)(row);
  row.tabIndex = 0;
  row.setAttribute("aria-expanded", "false");
  row.addEventListener("click", (event) => event.target.closest("a") || turn());
  row.addEventListener("keydown", (event) => {
    if (event.target === row && (event.key === "Enter" || event.key === " ")) {
      event.preventDefault();
      turn();
    }
  });
}

for (const table of document.querySelectorAll("table.sortable")) {
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => {
    const button = document.createElement("button");
    button.type = "button";
    button.append(...head.childNodes);
    head.append(button);
    button.addEventListener("click", () => {
      const down = head.getAttribute("aria-sort") !== "descending";
      heads.forEach((other) => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      [...table.tBodies[0].rows].forEach(close);
      const key = (row) => row.cells[column].dataset.key ?? row.cells[column].textContent;
      const order = (a, b) => {
        const [x, y] = [key(a), key(b)];
        const difference = isNaN(x) || isNaN(y) ? x.localeCompare(y) : x - y;
        return down ? -difference : difference;
      };
      table.tBodies[0].append(...[...table.tBodies[0].rows].sort(order));
    });
  });
}

// A link into a part that is folded opens it.
const unfold = () => {
  const target = location.hash && document.getElementById(decodeURIComponent(location.hash.slice(1)));
  if (!target) return;
  for (let part = target; part; part = part.parentElement) if (part.tagName === "DETAILS") part.open = true;
  target.scrollIntoView();
};
addEventListener("hashchange", unfold);
document.addEventListener("click", (event) => event.target.closest?.('a[href^="#"]') && setTimeout(unfold));
unfold();
