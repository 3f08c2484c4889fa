"use strict";
(() => {
  // viser reads the dark theme from the address, and only once.
  const address = new URL(location);
  if (matchMedia("(prefers-color-scheme: dark)").matches && !address.searchParams.has("darkMode")) {
    address.searchParams.set("darkMode", "");
    history.replaceState(history.state, "", address);
  }
  const SILENT = 1500; // time without a message after which this page has lost its GUI [ms]
  const NARROW = 1000; // page width below which the plots leave no room for the hand [CSS px]
  const AGAIN = 1000; // time between two attempts to reconnect [ms]
  let line, heard = performance.now(), lost = false, window_ = "", run = "", silent = 0;
  const bar = document.createElement("div");
  bar.id = "rtee-bar";
  bar.role = "banner";
  bar.innerHTML = `<button id="rtee-stop" type="button"
      title="Stop all devices now, whoever controls the hand (keys: S, Escape). Not a safety-rated emergency stop."
      >STOP</button>
    <div id="rtee-said" role="status"><span id="rtee-held"></span><span id="rtee-link"></span>
    <span id="rtee-mode"></span><span id="rtee-doing"></span></div>
    <button id="rtee-live" type="button" hidden>Back to live</button>`;
  const at = (name) => bar.querySelector(`#rtee-${name}`);
  const say = (name, text, tone = "plain") => {
    const place = at(name);
    if (place.textContent !== text) place.textContent = place.title = text;
    place.dataset.tone = tone;
  };
  const stop = () => {
    if (line?.readyState === WebSocket.OPEN && !lost) line.send("stop");
    else say("doing", "STOP did not leave this page: use the emergency stop", "bad");
  };
  at("stop").onclick = stop;
  // A message of a plot: the time that a person has clicked.
  addEventListener("rtee-say", (event) => line?.readyState === WebSocket.OPEN && line.send(event.detail));
  at("live").onclick = () => line.send("live");

  const show = (words) => {
    for (const name of ["held", "link", "mode", "doing"]) say(name, ...words[name]);
    document.title = words.title;
    document.documentElement.classList.toggle("rtee-old", words.old);
    document.documentElement.classList.toggle("rtee-recorded", words.recorded);
    at("live").hidden = !words.recorded;
    // A restarted GUI has other controls, which only a new page shows.
    if (run && run !== words.run) location.reload();
    run = words.run;
  };
  const tell = () => {
    if (!window_) return;
    line.send(window_);
    if (innerWidth < NARROW) line.send("narrow");
  };
  const connect = () => {
    line = new WebSocket(`${location.protocol.replace("http", "ws")}//${location.host}/bar`);
    line.onopen = tell;
    line.onmessage = (message) => {
      heard = performance.now();
      silent = 0;
      lost = false;
      if (message.data) show(JSON.parse(message.data));
    };
    line.onclose = () => setTimeout(connect, AGAIN);
  };
  const since = new Date(), NO_ANSWER = "the GUI does not answer";
  let why = NO_ANSWER, asking = false;
  const look = async () => {
    const own = document.querySelector("[data-rtee-window]")?.dataset.rteeWindow ?? "";
    if (own && own !== window_) {
      window_ = own;
      if (line.readyState === WebSocket.OPEN) tell();
    }
    // Count checks, too: a page that slept, or drew for long, has not read its messages meanwhile.
    if (performance.now() - heard < SILENT || ++silent < 4) return;
    if (!lost) {
      since.setTime(Date.now() - (performance.now() - heard));
      why = NO_ANSWER;
      say("doing", "");
    }
    lost = true;
    document.documentElement.classList.add("rtee-old");
    document.title = "no GUI";
    say("held", "no data", "bad");
    say("link", `this page shows the state at ${since.toTimeString().slice(0, 8)}; ${why}`, "bad");
    say("mode", "STOP cannot reach the hand, use the emergency stop", "bad");
    if (line.readyState === WebSocket.OPEN || asking) return;
    asking = true;
    try { // a network that is down may answer nothing at all
      const answer = await fetch("/", { cache: "no-store", signal: AbortSignal.timeout(AGAIN) });
      why = answer.status === 403 ? "the GUI was started again: open the address it has printed" : NO_ANSWER;
    } catch (error) {
      why = error.name === "TimeoutError" ? NO_ANSWER : "the GUI has ended";
    }
    asking = false;
  };

  const TYPED = new Set(["text", "number", "search", "password", "email", "url", ""]);
  const typing = (place) =>
    place instanceof HTMLTextAreaElement || place?.isContentEditable ||
    (place instanceof HTMLInputElement && TYPED.has(place.getAttribute("type") ?? "") &&
      !place.readOnly && place.getAttribute("aria-haspopup") !== "listbox");
  let left = null; // the field that Enter or Escape has just left; its keys are commands again
  let stopped = false; // whether the Escape that is held down has stopped the hand
  addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.metaKey || event.altKey) return;
    if (!event.repeat) stopped = false;
    else if (event.key !== "Escape" || stopped) return; // in panic, Escape is held down, in a field, too
    const text = typing(event.target) && event.target !== left;
    if (text && ["Enter", "Escape"].includes(event.key)) {
      const field = left = event.target;
      return setTimeout(() => { field.blur(); if (left === field) left = null; }); // once viser has sent it
    }
    if (text || !(event.key === "Escape" || event.key.toLowerCase() === "s")) return;
    stop();
    stopped = true;
    if (event.key === "Escape") return;
    event.preventDefault(); // do not type the letter
    event.stopImmediatePropagation(); // viser would move the camera
  }, true);

  // Add what viser's page lacks for screen readers and for use without a mouse.
  const name = (each, text) => text && !each.ariaLabel && (each.ariaLabel = text);
  const makeAccessible = () => {
    document.getElementById("root")?.setAttribute("role", "main");
    for (const each of document.querySelectorAll("[role=slider], .mantine-Input-input")) {
      let row = each;
      while (row && !row.querySelector("label")) row = row.parentElement;
      name(each, row?.querySelector("label")?.textContent);
    }
    for (const each of document.querySelectorAll("[role=progressbar]")) name(each, "progress");
    for (const each of document.querySelectorAll(".mantine-Notification-closeButton"))
      name(each, "close");
    for (const icon of document.querySelectorAll("button .tabler-icon")) {
      const button = icon.closest("button");
      if (!button.textContent) name(button, [...icon.classList].pop().replace("tabler-icon-", ""));
    }
    for (const icon of document.querySelectorAll("[class*=tabler-icon-chevron-]")) {
      const label = icon.closest("div.mantine-Paper-root > div.mantine-Paper-root");
      if (!label) continue;
      // A heading whose icon is the button; with the mouse, the whole label is a button.
      label.role = "heading";
      label.ariaLevel = "2";
      icon.tabIndex = 0;
      icon.role = "button";
      icon.ariaLabel = label.textContent;
      icon.ariaExpanded = String(icon.classList.contains("tabler-icon-chevron-up"));
      icon.onkeydown = (event) => ["Enter", " "].includes(event.key) && label.click();
    }
  };

  const begin = () => {
    document.body.prepend(bar);
    connect();
    setInterval(look, 250);
    setInterval(makeAccessible, 1000);
  };
  if (document.body) begin();
  else addEventListener("DOMContentLoaded", begin);
})();
