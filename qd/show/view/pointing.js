"use strict";
// Lines of the archive's plot can be pointed at: the nearest one is named and drawn thick, a click shows its elite.
{
  const NEAR = 8; // pixels of the plot's own scale
  let pointed = null; // the line that is named

  const lineAt = (event) => {
    const plot = event.target.closest?.("svg");
    const paths = [...(plot?.querySelectorAll("path[data-elites]") ?? [])];
    if (!paths.length) return null;
    const { x, y } = new DOMPoint(event.clientX, event.clientY).matrixTransform(plot.getScreenCTM().inverse());
    let best = null;
    for (const path of paths) {
      path.lines ??= path.getAttribute("d").split("M").slice(1)
        .map((line) => line.split("L").map((point) => point.split(" ").map(Number)));
      path.lines.forEach((points, k) => {
        const after = points.findIndex((point) => point[0] >= x);
        if (after < 1) return;
        const [[x0, y0], [x1, y1]] = [points[after - 1], points[after]];
        const slope = (y1 - y0) / (x1 - x0);
        const away = Math.abs(y0 + slope * (x - x0) - y) / Math.hypot(1, slope);
        if (away < (best?.away ?? NEAR)) best = { plot, path, k, away, x, y };
      });
    }
    return best;
  };

  const drop = () => document.querySelectorAll("svg .pointed").forEach((mark) => mark.remove());

  document.addEventListener("pointermove", (event) => {
    drop();
    pointed = lineAt(event);
    if (!pointed) return;
    const { plot, path, k, x, y } = pointed;
    const drawn = document.createElementNS(plot.namespaceURI, "path");
    drawn.setAttribute("d", "M" + path.getAttribute("d").split("M")[k + 1]);
    drawn.setAttribute("style", "fill:none;stroke:#000;stroke-width:2;pointer-events:none");
    const words = document.createElementNS(plot.namespaceURI, "text");
    words.textContent = path.dataset.hints.split("|")[k];
    words.setAttribute("x", x);
    words.setAttribute("y", Math.max(y - 8, 10));
    words.setAttribute("text-anchor", x < plot.viewBox.baseVal.width / 2 ? "start" : "end");
    words.setAttribute("style", "font-size:13px;font-weight:bold;fill:#000;stroke:#fff;stroke-width:3;"
      + "paint-order:stroke;pointer-events:none");
    for (const part of [drawn, words]) {
      part.classList.add("pointed");
      plot.append(part);
    }
  });

  // The page has no other way to its server than its own widgets: the number is typed into the field for it.
  document.addEventListener("click", (event) => {
    let line = lineAt(event);
    // A click's place is rounded, and lines are dense: what is named is what is meant.
    if (line && pointed?.path.isConnected && Math.hypot(pointed.x - line.x, pointed.y - line.y) < 2) line = pointed;
    const field = document.querySelector("form input[type=text], form input:not([type])");
    if (!line || !field) return;
    const number = line.path.dataset.elites.split(" ")[line.k];
    Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set.call(field, number);
    field.dispatchEvent(new Event("input", { bubbles: true }));
    setTimeout(() => field.form.requestSubmit(), 100); // when the page has sent what was typed
  });
}
