"use strict";
// The player bar under the scene, keys, and clicks on elites. What a visitor does goes to the server through a hidden
// text field, since a page of viser has no other way to it; the server calls faultline.show with what changed.
window.faultline?.stop();
window.faultline = (() => {
  const ended = new AbortController();
  const on = (target, name, act, capture) => target.addEventListener(name, act, { signal: ended.signal, capture });
  const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4];
  const bar = document.createElement("div");
  bar.id = "faultline";
  bar.innerHTML = `
    <button data-do="play" title="Play or pause: Space" aria-label="Play">▶</button>
    <div class="track"><input type="range" min="0" max="1" step="0.02" value="0" aria-label="Time"><div class="marks">
      </div><div class="progress"><i></i><span></span></div></div>
    <output></output>
    <div class="words"><b></b> <span></span></div>
    <div class="tools"><select data-do="episode" aria-label="Episode"></select>
      <select data-do="speed" aria-label="Speed">${SPEEDS.map((x) => `<option value="${x}">${x} x</option>`).join("")}
      </select><button data-do="mark" title="Go to the next mark: M">next mark</button>
      <label title="Go along with the robot: F"><input type="checkbox" data-do="follow"> follow</label></div>`;
  const style = document.createElement("style");
  const picked = document.createElement("style");
  style.textContent = `
    #root { height: calc(100dvh - var(--bar, 84px) - var(--sheet, 0px)) !important; }
    #faultline { position: fixed; left: 0; right: 0; bottom: var(--sheet, 0px); z-index: 20; box-sizing: border-box;
      padding: 6px 10px; display: grid; grid-template-columns: auto 1fr auto; gap: 4px 10px; align-items: center;
      grid-template-areas: "play track time" "words words words" "tools tools tools"; font-size: 13px; background: var(--mantine-color-body, #fff);
      border-top: 1px solid var(--mantine-color-default-border, #ccc); }
    #faultline > [data-do=play] { grid-area: play; width: 44px; height: 34px; font-size: 16px; }
    #faultline .track { grid-area: track; position: relative; height: 34px; }
    #faultline .track input { position: absolute; width: 100%; margin: 0; top: 1px; accent-color: #1971c2; z-index: 1; }
    #faultline .marks a { position: absolute; top: 2px; height: 14px; border-left: 2px solid #d6167a; cursor: pointer; }
    #faultline .marks a span { position: absolute; top: 17px; white-space: nowrap; font-size: 11px; }
    #faultline .progress { position: absolute; inset: 2px 0 14px; background: #e9ecef; border-radius: 4px;
      overflow: hidden; display: none; }
    #faultline.recording .progress { display: block; z-index: 2; }
    #faultline .progress i { position: absolute; inset: 0 auto 0 0; background: #74c0fc; }
    #faultline .progress span { position: relative; padding-left: 6px; font-size: 12px; color: #111; }
    #faultline output { grid-area: time; font-variant-numeric: tabular-nums; min-width: 76px; text-align: right; }
    #faultline .words { grid-area: words; overflow: hidden; white-space: nowrap; text-overflow: ellipsis; }
    #faultline .tools { grid-area: tools; display: flex; gap: 8px; align-items: center; min-width: 0; }
    #faultline .tools > * { flex: none; }
    #faultline .tools [data-do=episode] { flex: 1 1 6em; min-width: 0; }
    #faultline button, #faultline select { font: inherit; padding: 3px 8px; border-radius: 4px; cursor: pointer;
      border: 1px solid #adb5bd; background: var(--mantine-color-default, #fff); color: inherit; }
    #faultline .off { opacity: .45; pointer-events: none; }
    @media (max-width: 575px) { #faultline .words { white-space: normal; } }
    @media (min-width: 576px) { #faultline { grid-template-areas: "play track track time" "words words tools tools";
      grid-template-columns: auto 1fr auto auto; } #faultline .tools [data-do=episode] { flex: 0 1 17em; } }
    [data-floating-window]:has(.faultline-channel), .mantine-Tabs-root:has(.faultline-channel) { display: none; }
    .mantine-Paper-root[style*="position: fixed"] { width: 100vw !important; max-height: 48dvh !important; }
    .mantine-Paper-root[style*="position: fixed"] [style*="width: 20em"] { width: 100vw !important; }
    body:not(.unfolded) .mantine-Paper-root[style*="position: fixed"] { max-height: 3.5em !important; overflow: hidden; }
    body:not(.unfolded) .mantine-Paper-root[style*="position: fixed"]::after { content: "▲ elites, rates, film";
      position: absolute; top: 1.1em; left: 0; right: 0; text-align: center; font-size: 13px; pointer-events: none; }
    text.place { paint-order: stroke; stroke: var(--mantine-color-body, #fff); stroke-width: 3px; }
    circle[data-elite]:hover { stroke: #000; }
    [data-elite] { cursor: pointer; padding: 2px 6px; border-radius: 3px; }
    .faultline-list { max-height: 30dvh; overflow-y: auto; margin-top: 4px; }
    .faultline-rates { width: 100%; border-collapse: collapse; }
    .faultline-rates th, .faultline-rates td { text-align: left; font-weight: normal; padding: 2px 3px; line-height: 1.15;
      white-space: nowrap; }
    .faultline-rates small { display: block; color: #868e96; }
    .faultline-rates tr + tr { border-top: 1px solid var(--mantine-color-default-border, #ddd); }
    [data-elite]:hover { background: rgba(25, 113, 194, .12); }`;
  document.head.append(style, picked);
  document.body.append(bar);
  const find = (selector) => bar.querySelector(selector);
  const range = find("input[type=range]"), marks = find(".marks"), episode = find("[data-do=episode]");

  // To the server: the last value of each thing done, one message in 50 ms.
  let count = 0, waiting = {}, timer = null;
  const flush = () => {
    const marker = document.querySelector(".faultline-channel")?.parentElement;
    const field = marker?.nextElementSibling?.querySelector("input");
    timer = field ? null : setTimeout(flush, 50);
    if (!field) return;
    Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value").set
      .call(field, JSON.stringify([count++, waiting]));
    waiting = {};
    field.dispatchEvent(new Event("input", { bubbles: true }));
  };
  const send = (name, value = null) => {
    waiting[name] = value;
    timer ??= setTimeout(flush, 50);
  };
  const sizes = () => [window.innerWidth, window.innerHeight];

  // From the server.
  const state = {};
  let dragging = false;
  const share = (time) => Math.min(time / (state.duration || 1), 1);
  const placed = (time) => `calc(8px + ${share(time)} * (100% - 16px))`;
  const drawMarks = () => {
    marks.replaceChildren(...(state.marks ?? []).map(([time, words]) => {
      const mark = document.createElement("a");
      mark.style.left = placed(time);
      mark.title = `${words}, ${time.toFixed(1)} s`;
      mark.innerHTML = "<span></span>";
      mark.firstChild.textContent = words;
      mark.onclick = () => send("seek", time);
      return mark;
    }));
    let free = Infinity; // from here on there are other words; the last ones matter most
    for (const mark of [...marks.children].reverse()) {
      const words = mark.firstChild, room = marks.parentElement.offsetWidth;
      const left = Math.max(0, Math.min(mark.offsetLeft - words.offsetWidth / 2, room - words.offsetWidth));
      words.hidden = left + words.offsetWidth + 8 > free;
      words.style.left = `${left - mark.offsetLeft}px`;
      if (!words.hidden) free = left;
    }
  };
  const drawTime = () => {
    if (document.activeElement !== range || !dragging) range.value = state.time;
    find("output").textContent = `${state.time.toFixed(1)} / ${state.duration.toFixed(1)} s`;
    for (const over of document.querySelectorAll(".u-over")) {
      const now = over.querySelector(".now") ?? over.appendChild(document.createElement("i"));
      now.className = "now";
      now.style.cssText = `position:absolute;top:0;bottom:0;border-left:2px solid #d00;left:${100 * share(state.time)}%`;
    }
  };
  const drawEpisodes = () => {
    episode.replaceChildren(...(state.episodes ?? []).map(([words, members]) => {
      const group = document.createElement("optgroup");
      group.label = words;
      group.append(...members.map(([number, ending]) => new Option(ending, number)));
      return group;
    }));
  };
  const show = (changes) => {
    Object.assign(state, changes);
    if ("duration" in changes) range.max = Math.max(state.duration, 0.02);
    if ("marks" in changes || "duration" in changes) drawMarks();
    if ("episodes" in changes) drawEpisodes();
    if ("episode" in changes || "episodes" in changes) episode.value = state.episode;
    if ("time" in changes || "duration" in changes) drawTime();
    if ("playing" in changes) {
      find("[data-do=play]").textContent = state.playing ? "❚❚" : "▶";
      find("[data-do=play]").ariaLabel = state.playing ? "Pause" : "Play";
    }
    if ("title" in changes) find(".words b").textContent = state.title;
    if ("status" in changes) find(".words span").innerHTML = state.status;
    if ("speed" in changes) find("[data-do=speed]").value = state.speed;
    if ("follow" in changes) find("[data-do=follow]").checked = state.follow;
    if ("share" in changes) {
      bar.classList.toggle("recording", state.share !== null);
      find(".progress i").style.width = `${100 * (state.share ?? 0)}%`;
    }
    if ("task" in changes) find(".progress span").textContent = state.task;
    if ("enabled" in changes) for (const part of [range, find("[data-do=play]"), episode, find("[data-do=mark]")])
      part.classList.toggle("off", !state.enabled);
    if ("elite" in changes) {
      picked.textContent = `[data-elite="${state.elite}"] { background: rgba(213, 94, 0, .22) !important; }`;
      document.querySelector(`[data-elite="${state.elite}"]`)?.scrollIntoView({ block: "nearest" });
    }
  };
  show({ duration: 0, time: 0, speed: 1, title: "", status: "", share: 0, task: "Reading the archive …", enabled: false });

  // What a visitor does.
  on(range, "pointerdown", () => { dragging = true; });
  on(window, "pointerup", () => { dragging = false; range.blur(); });
  on(range, "input", () => send("seek", Number(range.value)));
  on(bar, "click", (event) => {
    if (event.target.tagName === "BUTTON") TASKS[event.target.dataset.do]();
    event.target.blur?.();
  });
  on(bar, "change", (event) => {
    const { target } = event, name = target.dataset.do;
    if (name) send(name, target.type === "checkbox" ? target.checked : Number(target.value));
    target.blur();
  });
  const pauseAt = (time) => { send("play", false); send("seek", time); };
  const TASKS = {
    play: () => send("play", !state.playing),
    mark: () => state.marks?.length && pauseAt((state.marks.find(([time]) => time > state.time + 1e-6) ?? state.marks[0])[0]),
  };
  const KEYS = { " ": TASKS.play, m: TASKS.mark, ArrowLeft: () => pauseAt(state.time - 0.1),
    ArrowRight: () => pauseAt(state.time + 0.1), n: () => send("step", 1), p: () => send("step", -1),
    f: () => send("follow", !state.follow), o: () => send("overview") };
  on(document, "keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    const field = event.target.closest("input:not([type=range], [type=checkbox]), textarea, select");
    if (field?.classList.contains("faultline-number") && event.key === "Enter") {
      send("pick", field.value);
      field.value = "";
      field.blur();
    }
    const task = KEYS[event.key] ?? (/^[1-9]$/.test(event.key) ? () => send("episode", Number(event.key)) : null);
    if (field || !task) return;
    event.preventDefault(); // neither scrolls a panel nor presses a button in focus
    event.stopPropagation(); // nor moves viser's camera
    document.activeElement?.blur();
    task();
  }, true);
  on(document, "click", (event) => {
    const row = event.target.closest("[data-elite]");
    const over = event.target.closest(".u-over");
    const sheet = event.target.closest('.mantine-Paper-root[style*="position: fixed"]');
    if (row) send("pick", row.dataset.elite);
    if (over) send("seek", (state.duration * event.offsetX) / over.offsetWidth);
    if (sheet && event.clientY < sheet.getBoundingClientRect().top + 44 && !event.target.closest("button")) {
      document.body.classList.toggle("unfolded"); // folded by us: viser's own sheet begins open
      event.stopPropagation();
    }
  }, true);
  on(window, "resize", () => { drawMarks(); send("resize", sizes()); });
  on(window, "popstate", () => send("open", location.search));

  const measure = setInterval(() => { // viser makes its sheet when it likes
    const sheet = document.querySelector('.mantine-Paper-root[style*="position: fixed"]');
    document.documentElement.style.setProperty("--bar", `${bar.offsetHeight}px`);
    document.documentElement.style.setProperty("--sheet", `${sheet?.offsetHeight ?? 0}px`);
  }, 200);
  send("hello", [location.search, ...sizes()]);
  return {
    show,
    address: (query, isNew) => history[isNew ? "pushState" : "replaceState"](history.state, "", `?${query}`),
    stop: () => { ended.abort(); clearInterval(measure); for (const part of [bar, style, picked]) part.remove(); },
  };
})();
