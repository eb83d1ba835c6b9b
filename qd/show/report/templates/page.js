"use strict";
for (const table of document.querySelectorAll("table.sortable")) {
  const heads = [...table.tHead.rows[0].cells];
  heads.forEach((head, column) => {
    if (!head.textContent) return;
    const button = document.createElement("button");
    button.type = "button";
    button.append(...head.childNodes);
    head.append(button);
    button.addEventListener("click", () => {
      const down = head.getAttribute("aria-sort") !== "descending";
      heads.forEach((other) => other.removeAttribute("aria-sort"));
      head.setAttribute("aria-sort", down ? "descending" : "ascending");
      const order = (a, b) => {
        const [x, y] = [a, b].map((row) => row.cells[column].textContent);
        const difference = parseFloat(x) - parseFloat(y);
        return (down ? -1 : 1) * (isNaN(difference) ? x.localeCompare(y) : difference);
      };
      table.tBodies[0].append(...[...table.tBodies[0].rows].sort(order));
    });
  });
}

// A table or a figure that is wider than the page says so.
const parts = document.querySelectorAll(".scroll");
const mark = () => parts.forEach((part) => part.classList.toggle("over", part.scrollWidth > part.clientWidth + 1));
for (const part of parts) {
  const hint = document.createElement("p");
  hint.className = "hint";
  hint.textContent = "It goes on to the right: drag or scroll it.";
  part.after(hint);
}
addEventListener("resize", mark);
document.querySelectorAll("details").forEach((part) => part.addEventListener("toggle", mark));
mark();

// What matters in print is unfolded for it where the style alone cannot.
const folded = [];
addEventListener("beforeprint", () =>
  document.querySelectorAll("details.print:not([open])").forEach((part) => { folded.push(part); part.open = true; }));
addEventListener("afterprint", () => folded.splice(0).forEach((part) => { part.open = false; }));
