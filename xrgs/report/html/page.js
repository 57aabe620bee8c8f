"use strict";
// Shared helpers, the filters, and the links of the paper's figures. Text from the data is only set
// as text, never as markup.
const data = JSON.parse(document.getElementById("data").textContent);
const SVG = "http://www.w3.org/2000/svg";
const filters = { scene: "", label: "", metric: "" };
const onFilter = [];

function element(name, attributes = {}, ...children) {
  const node = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  node.append(...children);
  return node;
}

function svg(name, attributes = {}, ...children) {
  const node = document.createElementNS(SVG, name);
  for (const [key, value] of Object.entries(attributes)) node.setAttribute(key, value);
  node.append(...children);
  return node;
}

function distinct(values) {
  return [...new Set(values)];
}

function fill(select, options, chosen) {
  select.replaceChildren(...options.map(([value, text]) => element("option", { value }, text)));
  if (data.single && select.parentElement?.tagName === "LABEL") select.parentElement.hidden = options.length < 2;
  if (chosen !== undefined) select.value = chosen;
}

// The name of an arm; the page of a single label calls it `render`.
function armName(label) {
  return data.single ? "render" : label;
}

// HR, LR or test; if photographs have one resolution, training or test.
function kindName(kind) {
  return data.mixed || kind === "test" ? kind : "training";
}

function labelled(text, select) {
  return element("label", {}, text, select);
}

// The name of a run: scene, condition, and replicate if there are several.
function runName(run) {
  const replicate = several("replicate") ? `replicate ${run.replicate}` : "";
  return [run.scene, run.condition, replicate].filter(Boolean).join(", ");
}

function several(key) {
  const all = [...data.views, ...data.history].map((run) => run[key]);
  return new Set(all).size > 1;
}

function showTip(text, x, y) {
  const tip = document.getElementById("tip");
  tip.textContent = text;
  tip.hidden = !text;
  if (!text) return;
  const { offsetWidth: width, offsetHeight: height } = tip;
  tip.style.left = `${Math.max(4, Math.min(x + 12, innerWidth - width - 8))}px`;
  tip.style.top = `${Math.max(4, Math.min(y + 12, innerHeight - height - 8))}px`;
}

const labels = distinct([data.base, ...data.trade_offs.map((row) => row.label)]);
const COLORS = ["#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#8a8a8a", "#7a5cff"];
function color(label) {
  return COLORS[Math.max(0, labels.indexOf(label)) % COLORS.length];
}

function passes(row) {
  const byLabel = !filters.label || row.label === filters.label || row.label === data.base;
  return byLabel && (!filters.scene || row.scene === filters.scene);
}

function startFilters() {
  const metrics = [...document.querySelectorAll("#changes-table tbody tr")].map((row) => row.dataset.metric);
  const choices = {
    scene: distinct(data.trade_offs.map((row) => row.scene)),
    label: labels.filter((label) => label !== data.base),
    metric: distinct(metrics),
  };
  for (const [key, values] of Object.entries(choices)) {
    const select = document.getElementById(`filter-${key}`);
    select.append(...values.map((value) => element("option", { value }, value)));
    select.addEventListener("change", () => {
      filters[key] = select.value;
      onFilter.forEach((update) => update());
    });
  }
}

function startFigures(sections) {
  for (const button of document.querySelectorAll(".figure-link")) {
    button.addEventListener("click", () => {
      const { section, place, label } = button.dataset;
      sections[section].show(Number(place), label);
      document.getElementById(section).scrollIntoView();
    });
  }
}

document.addEventListener("DOMContentLoaded", () => {
  if (!data.single) startFilters();
  startTables();
  const sections = { views: startViews(), training: startTraining() };
  startScores(sections.views);
  if (document.getElementById("curves")) startCurves();
  if (!data.single) startTradeOffs();
  startSplats();
  startFigures(sections);
});
