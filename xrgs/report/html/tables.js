// Tables: sorting by any column, the filters, and copies.
function sortKey(cell) {
  if (cell.dataset.value !== undefined) return cell.dataset.value === "" ? null : Number(cell.dataset.value);
  const text = cell.textContent.trim();
  const number = /^[+-]?[\d,]*\.?\d+(e[+-]?\d+)?/i.exec(text);
  if (number && cell.classList.contains("number")) return Number(number[0].replaceAll(",", ""));
  return text && text !== "n/a" ? text : null;
}

function compareKeys(first, second) {
  if (typeof first === "number" && typeof second === "number") return first - second;
  return String(first).localeCompare(String(second), undefined, { numeric: true });
}

// Sorts the rows of a table by a column; missing values stay at the end in both directions.
function sortBy(table, column, descending) {
  const rows = [...table.tBodies[0].rows].map((row, place) => ({ row, place, key: sortKey(row.cells[column]) }));
  rows.sort((a, b) => {
    if (a.key === null || b.key === null) return (a.key === null) - (b.key === null) || a.place - b.place;
    return (descending ? -1 : 1) * compareKeys(a.key, b.key) || a.place - b.place;
  });
  table.tBodies[0].append(...rows.map(({ row }) => row));
  [...table.tHead.rows[0].cells].forEach((head, place) => {
    if (place === column) head.setAttribute("aria-sort", descending ? "descending" : "ascending");
    else head.removeAttribute("aria-sort");
  });
}

function makeSortable(table) {
  [...table.tHead.rows[0].cells].forEach((head, column) => {
    const button = element("button", { type: "button" }, head.textContent);
    head.setAttribute("scope", "col");
    head.replaceChildren(button);
    button.addEventListener("click", () => sortBy(table, column, head.getAttribute("aria-sort") === "ascending"));
  });
}

function filterChanges() {
  for (const row of document.querySelectorAll("#changes-table tbody tr")) {
    const { scene, label, metric } = row.dataset;
    const hidden =
      (filters.scene && scene !== filters.scene) ||
      (filters.label && label !== filters.label) ||
      (filters.metric && metric !== filters.metric);
    row.hidden = Boolean(hidden);
  }
}

// The shown rows of the table of changes, in their order, in one of three formats.
function writtenChanges(form) {
  const { head, rows, foot } = data.changes[form];
  const shown = [...document.querySelectorAll("#changes-table tbody tr:not([hidden])")];
  return [...head, ...shown.map((row) => rows[Number(row.dataset.row)]), ...foot].join("\n");
}

async function copy(text, button) {
  const before = button.textContent;
  try {
    await navigator.clipboard.writeText(text);
    button.textContent = "Copied";
  } catch {
    // Pages from a file may not write the clipboard: show the text, selected, for Ctrl+C.
    const area = element("textarea", { rows: "8", cols: "60", "aria-label": "Text to copy" });
    area.value = text;
    button.parentElement.querySelector("textarea")?.remove();
    button.parentElement.append(area);
    area.select();
    button.textContent = "Press Ctrl+C";
  }
  setTimeout(() => (button.textContent = before), 2000);
}

function startTables() {
  document.querySelectorAll("#changes-table, #tables .sortable").forEach(makeSortable);
  for (const group of document.querySelectorAll(".copies")) {
    for (const button of group.querySelectorAll("button")) {
      button.addEventListener("click", () => {
        const { form } = button.dataset;
        const place = group.dataset.copies;
        copy(place === "changes" ? writtenChanges(form) : data.copies[Number(place)][form], button);
      });
    }
  }
  onFilter.push(filterChanges);
}
