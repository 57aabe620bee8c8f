// Pictures of a view: a large one with a slider between any two, tiles of all, a loupe on all.
const LOUPE = { side: 120, zoom: 4, step: 0.02 };

function picture(place, alt) {
  return element("img", { src: data.images[place], alt, decoding: "async" });
}

// Shows one view (entry) of a list. `pictures(entry)` returns its pictures, as
// { name, caption, image, alt }; at first the first and the last are compared.
class Viewer {
  constructor(body, entries, pictures, name) {
    Object.assign(this, { entries, pictures, name, at: { x: 0.5, y: 0.5 }, loupes: [] });
    this.run = element("select", { "aria-label": "Scene" });
    this.view = element("select", { "aria-label": "View" });
    this.left = element("select", { "aria-label": "Left of the slider" });
    this.right = element("select", { "aria-label": "Right of the slider" });
    this.stage = element("div", { class: "stage", tabindex: "0", role: "group" });
    this.slider = element("input", { type: "range", class: "slider", min: "0", max: "100", value: "50", "aria-label": "Where the two pictures meet, percent" });
    this.tiles = element("div", { class: "tiles" });
    const controls = element("div", { class: "controls" }, labelled("Scene", this.run), labelled("View", this.view), labelled("Left", this.left), labelled("Right", this.right));
    body.append(controls, this.stage, this.slider, this.tiles);
    this.runs = distinct(entries.map(runName));
    fill(this.run, this.runs.map((run) => [run, run]));
    this.run.addEventListener("change", () => this.chooseRun());
    this.view.addEventListener("change", () => this.draw());
    this.left.addEventListener("change", () => this.compare());
    this.right.addEventListener("change", () => this.compare());
    this.slider.addEventListener("input", () => this.divide());
    this.stage.addEventListener("keydown", (event) => this.key(event));
    onFilter.push(() => this.follow());
    this.chooseRun();
  }

  follow() {
    const wanted = this.entries.find((entry) => !filters.scene || entry.scene === filters.scene);
    if (wanted && filters.scene && this.entry().scene !== filters.scene) {
      this.run.value = runName(wanted);
      this.chooseRun();
    }
    if (filters.label) this.prefer(filters.label);
  }

  entry() {
    return this.entries[Number(this.view.value)];
  }

  show(place, label) {
    this.run.value = runName(this.entries[place]);
    this.chooseRun();
    this.view.value = place;
    this.draw();
    this.prefer(label);
  }

  prefer(label) {
    const place = this.shown.findIndex((one) => one.label === label);
    if (place < 0) return;
    this.right.value = place;
    this.compare();
  }

  chooseRun() {
    const places = this.entries.map((entry, place) => place).filter((place) => runName(this.entries[place]) === this.run.value);
    fill(this.view, places.map((place) => [place, this.name(this.entries[place])]));
    this.draw();
  }

  draw() {
    const kept = [this.left.value, this.right.value];
    this.shown = this.pictures(this.entry());
    const comparable = this.shown.filter((one) => !one.apart);
    const options = comparable.map((one) => [this.shown.indexOf(one), one.name]);
    fill(this.left, options, kept[0]);
    fill(this.right, options, kept[1]);
    if (!kept[0] || this.left.selectedIndex < 0) this.left.selectedIndex = 0;
    if (!kept[1] || this.right.selectedIndex < 0) this.right.selectedIndex = options.length - 1;
    this.loupes = [];
    this.tiles.replaceChildren(...this.shown.map((one) => this.tile(one)));
    this.compare();
  }

  tile(one) {
    const image = picture(one.image, one.alt);
    if (one.coarse) image.classList.add("pixelated");
    const frame = element("div", { class: "tile" }, image);
    this.watch(frame, image);
    return element("figure", {}, frame, element("figcaption", {}, element("b", {}, one.name), ` ${one.caption}`));
  }

  compare() {
    const [left, right] = [this.left, this.right].map((select) => this.shown[Number(select.value)]);
    this.loupes = this.loupes.filter((loupe) => loupe.frame !== this.stage);
    const images = [left, right].map((one) => picture(one.image, one.alt));
    this.over = images[1];
    this.divider = element("div", { class: "divide" });
    this.stage.setAttribute("aria-label", `${left.name}, left of the slider, and ${right.name}, right of it. Arrow keys move a loupe.`);
    this.stage.replaceChildren(...images, this.divider, element("span", { class: "side left" }, left.name), element("span", { class: "side right" }, right.name));
    this.watch(this.stage, images[0]);
    this.divide();
  }

  divide() {
    const share = Number(this.slider.value);
    this.over.style.clipPath = `inset(0 0 0 ${share}%)`;
    this.divider.style.left = `calc(${share}% - 1px)`;
  }

  watch(frame, image) {
    this.loupes.push({ frame, image });
    frame.onpointermove = (event) => {
      const box = frame.getBoundingClientRect();
      this.point((event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height);
    };
    frame.onpointerleave = () => this.endLoupe();
  }

  key(event) {
    const moves = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
    const move = moves[event.key];
    if (event.key === "Escape") this.endLoupe();
    if (!move) return;
    event.preventDefault();
    this.point(this.at.x + move[0] * LOUPE.step, this.at.y + move[1] * LOUPE.step);
  }

  point(x, y) {
    this.at = { x: Math.min(1, Math.max(0, x)), y: Math.min(1, Math.max(0, y)) };
    for (const loupe of this.loupes) this.magnify(loupe);
  }

  // On the large picture the loupe shows the picture under it, left or right of the slider.
  magnify(loupe) {
    const { frame } = loupe;
    loupe.canvas ??= element("canvas", { width: LOUPE.side, height: LOUPE.side, "aria-hidden": "true" });
    frame.append(loupe.canvas);
    loupe.canvas.style.left = `${this.at.x * 100}%`;
    loupe.canvas.style.top = `${this.at.y * 100}%`;
    const onRight = frame === this.stage && this.at.x * 100 > Number(this.slider.value);
    const image = onRight ? this.over : loupe.image;
    // All loupes show the same part of the scene, whatever the size of the picture.
    const part = LOUPE.side / LOUPE.zoom / Math.max(1, this.entrySize()[0]);
    const width = part * image.naturalWidth;
    const height = width;
    const context = loupe.canvas.getContext("2d");
    context.imageSmoothingEnabled = false;
    context.clearRect(0, 0, LOUPE.side, LOUPE.side);
    context.drawImage(image, this.at.x * image.naturalWidth - width / 2, this.at.y * image.naturalHeight - height / 2, width, height, 0, 0, LOUPE.side, LOUPE.side);
  }

  entrySize() {
    return this.entry().rendered ?? this.entry().size;
  }

  endLoupe() {
    for (const loupe of this.loupes) loupe.canvas?.remove();
  }
}

function scoresText(scores) {
  const known = data.scores.filter((score) => scores[score.name] !== null);
  return known.map((score) => `${score.label} ${scores[score.name].toFixed(score.name.startsWith("psnr") ? 2 : 4)}`).join("; ");
}

function testPictures(entry) {
  const at = `test view ${entry.view}, ${entry.scene}`;
  const arms = entry.arms.filter((arm) => arm.image !== undefined);
  const hidden = entry.hidden ? `; a mask hides ${(100 * entry.hidden).toFixed(1)} % of it` : "";
  return [
    { name: "photograph", caption: `${entry.size[0]} × ${entry.size[1]} px${hidden}`, image: entry.photograph, alt: `Photograph: ${at}` },
    ...arms.map((arm) => ({ name: armName(arm.label), label: arm.label, caption: scoresText(arm.scores), image: arm.image, alt: `Render by ${arm.label}: ${at}. ${scoresText(arm.scores)}` })),
    ...arms.map((arm) => ({ name: data.single ? "error" : `error of ${arm.label}`, caption: "", image: arm.error, apart: true, alt: `Error map of ${arm.label}: ${at}` })),
  ];
}

function trainingPictures(entry) {
  const at = `training view ${entry.view}, ${entry.scene}`;
  const size = `${entry.size[0]} × ${entry.size[1]} px`;
  const found = [{ name: data.mixed ? `${entry.tag} photograph` : "photograph", caption: `as trained on, ${size}`, image: entry.photograph, coarse: data.mixed && entry.tag === "LR", alt: `${kindName(entry.tag)} photograph, ${size}: ${at}` }];
  if (entry.original !== null) found.push({ name: "original", caption: "before it was degraded; only all_hr trains on it", image: entry.original, alt: `The photograph before it was degraded: ${at}` });
  return [...found, ...entry.arms.map((arm) => ({ name: armName(arm.label), label: arm.label, caption: data.single ? "" : "render", image: arm.image, alt: `Render by ${arm.label}: ${at}` }))];
}

function startViewer(id, entries, pictures, name, missing) {
  const body = document.getElementById(id);
  if (!body) return { show() {} };
  if (entries.length) return new Viewer(body, entries, pictures, name);
  body.append(element("p", { class: "warning" }, missing));
  return { show() {} };
}

// Views without images are only in the table of scores.
function startViews() {
  const seen = data.views.filter((entry) => entry.photograph !== undefined);
  const viewer = startViewer("views-body", seen, testPictures, (entry) => (entry.psnr === null ? entry.view : `${entry.view}, ${entry.psnr.toFixed(1)} dB`), "This page has no pictures of test views; the end of the page says why.");
  return { show: (place, label) => viewer.show(seen.indexOf(data.views[place]), label) };
}

function startTraining() {
  const name = (entry) => (data.mixed ? `${entry.tag} ${entry.view}` : entry.view);
  return startViewer("training-body", data.training, trainingPictures, name, "This page has no training views; the end of the page says why.");
}

function startScores(viewer) {
  const table = document.getElementById("scores-table");
  if (!table) return;
  const ofRun = !data.single || distinct(data.views.map(runName)).length > 1;
  const names = [...(ofRun ? ["Scene"] : []), "View", ...(data.single ? [] : ["Arm"])];
  const head = element("tr", {}, ...names.map((text) => element("th", {}, text)), ...data.scores.map((score) => element("th", { class: "number" }, score.label)));
  table.tHead.append(head);
  const rows = data.views.flatMap((entry, place) => entry.arms.map((arm) => ({ entry, place, arm })));
  for (const { entry, place, arm } of rows) {
    const name = entry.photograph === undefined ? entry.view : element("button", { type: "button", class: "row-link" }, entry.view);
    if (entry.photograph !== undefined) {
      name.addEventListener("click", () => {
        viewer.show(place, arm.label);
        document.getElementById("views").scrollIntoView();
      });
    }
    const numbers = data.scores.map((score) => {
      const value = arm.scores[score.name];
      const text = value === null ? "n/a" : value.toFixed(score.name.startsWith("psnr") ? 2 : 4);
      return element("td", { class: "number", "data-value": value ?? "" }, text);
    });
    const row = element("tr", {}, ...(ofRun ? [element("td", {}, runName(entry))] : []), element("td", {}, name), ...(data.single ? [] : [element("td", {}, arm.label)]), ...numbers);
    Object.assign(row.dataset, { scene: entry.scene, label: arm.label });
    table.tBodies[0].append(row);
  }
  makeSortable(table);
  // The page of a single label sorts by PSNR, as the views above.
  const by = data.single ? Math.max(0, data.scores.findIndex((score) => score.name === "psnr")) : 0;
  sortBy(table, names.length + by, !data.scores[by].higher);
  onFilter.push(() => {
    for (const row of table.tBodies[0].rows) row.hidden = !passes(row.dataset);
  });
}
