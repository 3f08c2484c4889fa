"use strict";
// Number fields. viser sends every keystroke that makes a number ("9" of "90", which a hand would go to), ignores all
// others, and moves a number into its range only later. Here, what is typed counts once it is entered, by Enter or by
// leaving the field, and only if it is a number in the field's range. In a field that acts on the hand at once, only
// Enter counts: focus leaves a field on the way to STOP, too. What does not count brings back the value in force and a
// sentence that says why, and a click that left the field presses no button, except those that end something.
(() => {
  const NUMBER = /^[+-]?(\d+\.?\d*|\.\d+)$/, DIGITS = 6; // most decimals of a step
  const ENDING = new Set(["Cancel", "Finish", "Back to live"]); // buttons that need no number
  const value = Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, "value");
  let typed = null; // the field in which somebody types
  let refused = null; // the row of the field that this click has left and whose text was refused, and why
  let pressed = false; // whether a pointer is down: what it will click on must not move
  let sending = false;
  const sentence = document.createElement("div");
  sentence.id = "rtee-refused";
  sentence.role = "alert";
  const isNumberField = (place) => place?.classList?.contains("mantine-NumberInput-input");
  const rowOf = (field) => {
    let row = field;
    while (!row.querySelector("label")) row = row.parentElement;
    return row;
  };
  const rangeOf = (field, row) => {
    const slider = row.querySelector("[role=slider]");
    if (slider) return { min: Number(slider.ariaValueMin), max: Number(slider.ariaValueMax) };
    // A field without a slider has its range only in React's tree.
    let fiber = field[Object.keys(field).find((key) => key.startsWith("__reactFiber$"))];
    while (fiber && !("min" in (fiber.memoizedProps ?? {}))) fiber = fiber.return;
    const { min = -Infinity, max = Infinity } = fiber?.memoizedProps ?? {};
    return { min, max };
  };
  const actsAtOnce = (label) => {
    const named = document.querySelector("[data-rtee-at-once]")?.dataset.rteeAtOnce ?? "[]";
    return JSON.parse(named).includes(label);
  };
  const say = ({ row, why }) => {
    sentence.textContent = why;
    row.parentElement.append(sentence);
  };

  const begin = (field) => {
    if (typed === field) return;
    if (typed) enter();
    typed = field;
    field.rteeOwn = Object.getOwnPropertyDescriptor(field, "value");
    // viser's field takes its next text for an edit of the part that was selected at the last key; this makes it all.
    const { selectionStart, selectionEnd } = field;
    field.select();
    field.dispatchEvent(new KeyboardEvent("keydown", { bubbles: true, key: "Unidentified" }));
    field.setSelectionRange(selectionStart, selectionEnd);
    // React, which writes the value in force whenever it draws the field, must not write over what is typed.
    Object.defineProperty(field, "value", { configurable: true, get: value.get, set: () => {} });
    field.setSelectionRange = () => {};
  };
  const end = () => {
    const field = typed;
    typed = null;
    if (field.rteeOwn) Object.defineProperty(field, "value", field.rteeOwn);
    else delete field.value;
    delete field.setSelectionRange;
    field.value = field.defaultValue; // React keeps the value in force there
    return field;
  };
  const enter = (byKey = false) => {
    const text = typed.value.trim(), field = end(), row = rowOf(field);
    const { min, max } = rangeOf(field, row), label = row.querySelector("label").textContent;
    let why = "";
    if (!NUMBER.test(text) || Number(text) < min || Number(text) > max) {
      const range = min > -Infinity && max < Infinity ? `${min} to ${max}` : "a number";
      why = `should be ${range}, not ${text || "empty"}`;
    } else if (!byKey && actsAtOnce(label)) why = "acts on the hand only by Enter";
    if (why) {
      refused = { row, why: `${label} ${why}; it is ${field.value} again` };
      if (!pressed) say(refused);
      return;
    }
    value.set.call(field, String(Number(Number(text).toFixed(DIGITS))));
    sending = true;
    field.dispatchEvent(new InputEvent("input", { bubbles: true }));
    sending = false;
  };

  addEventListener("beforeinput", (event) => {
    const changes = event.inputType !== "insertLineBreak"; // of Enter, which types nothing
    if (changes && isNumberField(event.target)) begin(event.target);
  }, true);
  for (const kind of ["input", "change"])
    addEventListener(kind, (event) => {
      if (sending || !isNumberField(event.target)) return;
      event.stopImmediatePropagation(); // viser would send it
      if (kind === "input") sentence.remove();
    }, true);
  // Not when the whole window loses the focus: the person may come back and type on.
  addEventListener("focusout", () => typed && document.activeElement !== typed && enter(), true);
  addEventListener("keydown", (event) => {
    if (!event.isTrusted) return;
    refused = null;
    if (!typed || event.target !== typed || event.isComposing) return;
    if (event.key === "Escape") end();
    else if (["Enter", "ArrowUp", "ArrowDown"].includes(event.key)) enter(event.key === "Enter");
    else event.stopPropagation(); // see `begin`
  }, true);
  addEventListener("pointerdown", (event) => {
    refused = null;
    pressed = true;
    // A slider, or an arrow, of the same value.
    if (typed && event.target !== typed && rowOf(typed).contains(event.target)) enter();
  }, true);
  for (const kind of ["pointerup", "pointercancel"])
    addEventListener(kind, () => {
      pressed = false;
      if (refused) setTimeout(say, 0, refused); // after the click
    }, true);
  addEventListener("click", (event) => {
    if (typed && event.target !== typed) enter(); // where a click leaves the focus in the field
    const button = event.target.closest?.("button");
    const tab = refused?.row.closest("[role=tabpanel], .mantine-ScrollArea-content");
    // Not the buttons outside the tab, which end a motion or open the hand, too.
    if (button && tab?.contains(button) && !ENDING.has(button.textContent)) {
      event.preventDefault();
      event.stopImmediatePropagation();
      refused.why += `, and ${button.textContent || "the button"} was not pressed`;
      say(refused);
    } else if (!refused) sentence.remove();
    if (!event.isTrusted) refused = null;
  }, true);
})();
