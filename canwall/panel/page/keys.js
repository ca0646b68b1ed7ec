// Keys for everything. The space bar stops, whatever has the focus.

const TEXTS = 'input[type="text"], textarea';
const ARROWS = 'input, select, textarea, [role="tab"], canvas[tabindex]';
const NUMBERS = 'input[type="number"], input[type="text"], select, textarea';

/** Text fields need the space bar; with Shift it stops there as well. */
function stops(event) {
  return event.code === "Space" && (event.shiftKey || !event.target.closest?.(TEXTS));
}

/**
 * Call actions by key.
 * @param {object} actions stop, stiffness(factor), digit(n), and others by their key
 */
export function beginKeys(actions) {
  addEventListener("keydown", (event) => {
    if (stops(event)) {
      event.preventDefault();
      event.stopPropagation();
      if (!event.repeat) actions.stop();
      return;
    }
    if (event.ctrlKey || event.altKey || event.metaKey) return;
    const focus = event.target;
    const arrow = { ArrowLeft: -1, ArrowDown: -1, ArrowRight: 1, ArrowUp: 1 }[event.key];
    let action;
    if (arrow && !focus.closest?.(ARROWS)) {
      action = () => actions.arrow(arrow, event.shiftKey);
    } else if (!focus.closest?.(NUMBERS)) {
      if (/^[1-9]$/.test(event.key)) action = () => actions.digit(Number(event.key));
      else if (!event.repeat) action = actions[event.key.toLowerCase()];
    } else if (event.key === "Escape") {
      action = () => focus.blur();
    }
    if (action) {
      event.preventDefault();
      action();
    }
  }, { capture: true });
  // A button would be pressed when the space bar is let go.
  addEventListener("keyup", (event) => {
    if (stops(event)) {
      event.preventDefault();
      event.stopPropagation();
    }
  }, { capture: true });
}

/** Tabs as ARIA has them: arrows move, the focus follows. */
export function beginTabs(list) {
  const tabs = [...list.querySelectorAll('[role="tab"]')];
  const choose = (tab) => {
    for (const each of tabs) {
      const chosen = each === tab;
      each.setAttribute("aria-selected", chosen);
      each.tabIndex = chosen ? 0 : -1;
      document.getElementById(each.getAttribute("aria-controls")).hidden = !chosen;
    }
  };
  for (const [i, tab] of tabs.entries()) {
    tab.addEventListener("click", () => choose(tab));
    tab.addEventListener("keydown", (event) => {
      const step = { ArrowLeft: -1, ArrowRight: 1 }[event.key];
      if (!step) return;
      event.preventDefault();
      const next = tabs[(i + step + tabs.length) % tabs.length];
      choose(next);
      next.focus();
    });
  }
  return (id) => choose(document.getElementById(id));
}
