// Tables and lists of names and values.

/** A table of texts and numbers. */
export function table(columns, rows, caption) {
  const whole = document.createElement("table");
  if (caption) whole.createCaption().textContent = caption;
  const head = whole.createTHead().insertRow();
  for (const name of columns) {
    const cell = document.createElement("th");
    cell.scope = "col";
    cell.textContent = name;
    head.append(cell);
  }
  const body = whole.createTBody();
  for (const row of rows) {
    const line = body.insertRow();
    for (const value of row) {
      line.insertCell().textContent = typeof value === "number" ? String(Number(value.toPrecision(4))) : value ?? "–";
    }
  }
  return whole;
}

/** Fills a list of definitions with names and their values; those without a value are left out. */
export function define(list, lines) {
  const known = lines.filter(([, value]) => value || value === 0);
  list.replaceChildren(...known.map(([name, value]) => {
    const line = document.createElement("div");
    const term = document.createElement("dt");
    const text = document.createElement("dd");
    term.textContent = name;
    text.textContent = value;
    line.append(term, text);
    return line;
  }));
}
