// Curves and scatter plots as SVG. Every mark has its name as a tooltip and for screen readers.
const PLOT = { width: 460, height: 270, left: 62, right: 14, top: 10, bottom: 40 };
const RULES = {
  gaussians: "Gaussians",
  duplicated: "Gaussians duplicated",
  split: "Gaussians split",
  pruned_opacity: "Pruned: transparent",
  pruned_scale: "Pruned: too large",
  pruned_by_components: "Pruned: by components",
  pruned_non_finite: "Pruned: not finite",
};
const OVER = { step: "step", seconds: "seconds of training", evaluations: "alpha evaluations" };

// A number as text: with four digits, or as many as a step between numbers needs. Numbers up to
// `most` get the same unit.
function brief(value, step, most = value) {
  if (value === 0) return "0";
  const [from, unit] = [[1e9, " G"], [1e6, " M"], [1e3, " k"]].find(([size]) => Math.abs(most) >= Math.max(size, 1e4)) ?? [1, ""];
  const digits = step ? Math.max(0, -Math.floor(Math.log10(step / from) + 1e-9)) : undefined;
  return `${step ? (value / from).toFixed(Math.min(digits, 6)) : Number((value / from).toPrecision(4))}${unit}`;
}

// About five round numbers from least to most, with their texts.
function ticks(least, most) {
  const rough = (most - least || Math.abs(most) || 1) / 5;
  const power = 10 ** Math.floor(Math.log10(rough));
  const step = [1, 2, 5, 10].map((by) => by * power).find((by) => by >= rough * 0.999);
  const found = [];
  for (let value = Math.ceil(least / step) * step; value <= most + step * 1e-6; value += step) found.push([value, brief(value, step, Math.max(Math.abs(least), Math.abs(most)))]);
  return found;
}

function extent(values) {
  const least = Math.min(...values);
  const most = Math.max(...values);
  const room = (most - least || Math.abs(most) || 1) * 0.05;
  return [least - room, most + room];
}

// Series are { name, label, points: [[x, y], ...], faint, marks }.
function chart(title, series, xName, yName) {
  const points = series.flatMap((one) => one.points);
  const figure = element("div", { class: "chart" }, element("h3", {}, title));
  if (!points.length) {
    figure.append(element("p", { class: "note" }, "Nothing of this was recorded for what the filters show."));
    return figure;
  }
  const [x0, x1] = extent(points.map(([x]) => x));
  const [y0, y1] = extent(points.map(([, y]) => y));
  const { width, height, left, right, top, bottom } = PLOT;
  const x = (value) => left + ((value - x0) / (x1 - x0)) * (width - left - right);
  const y = (value) => height - bottom - ((value - y0) / (y1 - y0)) * (height - top - bottom);
  const names = distinct(series.map((one) => one.label)).join(", ");
  const drawing = svg("svg", { viewBox: `0 0 ${width} ${height}`, role: "group", "aria-label": `${title}: ${yName} over ${xName}, for ${names}` });
  for (const [value, text] of ticks(x0, x1)) {
    drawing.append(svg("line", { class: "axis", x1: x(value), x2: x(value), y1: top, y2: height - bottom }));
    drawing.append(svg("text", { x: x(value), y: height - bottom + 16, "text-anchor": "middle" }, text));
  }
  for (const [value, text] of ticks(y0, y1)) {
    drawing.append(svg("line", { class: "axis", x1: left, x2: width - right, y1: y(value), y2: y(value) }));
    drawing.append(svg("text", { x: left - 6, y: y(value) + 4, "text-anchor": "end" }, text));
  }
  drawing.append(svg("text", { x: (left + width - right) / 2, y: height - 6, "text-anchor": "middle" }, xName));
  for (const one of series) drawing.append(...seriesOf(one, x, y, xName, yName));
  figure.append(drawing);
  return figure;
}

function seriesOf(one, x, y, xName, yName) {
  const drawn = [];
  const path = one.points.map(([px, py]) => `${x(px).toFixed(1)},${y(py).toFixed(1)}`).join(" ");
  if (!one.marks) {
    const line = svg("polyline", { class: one.faint ? "series faint" : "series", points: path, stroke: color(one.label) });
    line.addEventListener("pointermove", (event) => showTip(one.name, event.clientX, event.clientY));
    line.addEventListener("pointerleave", () => showTip(""));
    drawn.push(line);
  }
  if (one.marks || (one.points.length <= 12 && !one.faint)) {
    const radius = one.marks ? 6 : 3;
    for (const [px, py] of one.points) {
      const text = `${one.name}\n${xName} ${brief(px)}\n${yName} ${brief(py)}`;
      const mark = svg("circle", { class: "point", cx: x(px), cy: y(py), r: radius, fill: color(one.label), role: "img", "aria-label": text.replaceAll("\n", ", ") });
      if (one.marks) mark.setAttribute("tabindex", "0");
      mark.addEventListener("pointerenter", (event) => showTip(text, event.clientX, event.clientY));
      mark.addEventListener("pointerleave", () => showTip(""));
      mark.addEventListener("focus", () => {
        const box = mark.getBoundingClientRect();
        showTip(text, box.right, box.bottom);
      });
      mark.addEventListener("blur", () => showTip(""));
      drawn.push(mark);
    }
  }
  return drawn;
}

function legend(of) {
  return of.map((label) => {
    const line = svg("svg", { viewBox: "0 0 18 12", "aria-hidden": "true" }, svg("line", { x1: 0, x2: 18, y1: 6, y2: 6, stroke: color(label), "stroke-width": 4 }));
    return element("span", {}, line, label);
  });
}

function seriesFrom(rows, over, name) {
  return rows
    .filter((row) => passes(row) && row[name] && row[over])
    .map((row) => ({
      name: `${row.label}: ${runName(row)}`,
      label: row.label,
      points: row[over].map((x, place) => [x, row[name][place]]).filter(([x, y]) => x !== null && y !== null),
    }))
    .filter((one) => one.points.length);
}

// Adds the mean of each label with several series of one length, and makes these series faint.
function withMeans(series) {
  const means = distinct(series.map((one) => one.label)).flatMap((label) => {
    const runs = series.filter((one) => one.label === label);
    const count = runs[0].points.length;
    if (runs.length < 2 || runs.some((one) => one.points.length !== count)) return [];
    runs.forEach((one) => (one.faint = true));
    const mean = (at, axis) => runs.reduce((sum, one) => sum + one.points[at][axis], 0) / runs.length;
    return [{ name: `${label}: mean of ${runs.length} runs`, label, points: runs[0].points.map((_, at) => [mean(at, 0), mean(at, 1)]) }];
  });
  return [...series, ...means];
}

function startCurves() {
  const over = document.getElementById("curves-over");
  const rule = document.getElementById("curves-rule");
  const known = Object.keys(RULES).filter((name) => data.history.some((row) => row[name]?.some((value) => value)));
  fill(rule, known.filter((name) => name !== "gaussians").map((name) => [name, RULES[name]]));
  const body = document.getElementById("curves-body");
  // A short training has no evaluations on its way.
  const measured = data.scores.filter((score) => data.curves.some((row) => row[score.name]?.some((value) => value !== null)));
  over.parentElement.hidden = !measured.length;
  const draw = () => {
    const scores = measured.filter((score) => score.name !== "ssim" || filters.metric === "SSIM");
    const charts = scores.map((score) => chart(`${score.label} of the test views`, withMeans(seriesFrom(data.curves, over.value, score.name)), OVER[over.value], score.label));
    charts.push(chart("Gaussians", withMeans(seriesFrom(data.history, "step", "gaussians")), OVER.step, "Gaussians"));
    if (rule.value) charts.push(chart(RULES[rule.value], withMeans(seriesFrom(data.history, "step", rule.value)), OVER.step, "so far"));
    body.replaceChildren(...charts);
    const used = data.single && labels.length < 2 ? [] : labels.filter((label) => passes({ label, scene: filters.scene }));
    document.getElementById("curves-legend").replaceChildren(...legend(used));
  };
  over.addEventListener("change", draw);
  rule.addEventListener("change", draw);
  onFilter.push(draw);
  draw();
}

function startTradeOffs() {
  const body = document.getElementById("trade-off-body");
  const draw = () => {
    const rows = data.trade_offs.filter((row) => passes(row) && row.gaussians !== null);
    const charts = data.scores.map((score) => {
      const series = rows
        .filter((row) => row[score.name] !== null)
        .map((row) => ({ name: [row.label, row.scene, row.condition].filter(Boolean).join(", "), label: row.label, marks: true, points: [[row.gaussians, row[score.name]]] }));
      return chart(`${score.label}, ${score.higher ? "higher" : "lower"} is better`, series, "Gaussians", score.label);
    });
    body.replaceChildren(...charts);
    const used = labels.filter((label) => rows.some((row) => row.label === label));
    document.getElementById("trade-off-legend").replaceChildren(...legend(used));
  };
  onFilter.push(draw);
  draw();
}
