// Keys for the buttons of a question, and how long an answer took.
"use strict";
(() => {
  const answers = document.getElementById("answers");
  if (!answers) return;
  const KEYS = { ArrowLeft: "first", ArrowRight: "second", ArrowDown: "tie", " ": "skip" };
  let since = performance.now();
  let sent = false;
  window.popl.ready.then(() => {
    since = performance.now();
    answers.dataset.ready = "true";
  });

  answers.addEventListener("submit", (event) => {
    if (sent) {
      event.preventDefault(); // a second click says nothing new
      return;
    }
    sent = true;
    answers.elements.seconds.value = ((performance.now() - since) / 1000).toFixed(2);
  });

  document.addEventListener("keydown", (event) => {
    if (event.altKey || event.ctrlKey || event.metaKey || event.shiftKey || event.repeat) return;
    // A button that has the focus keeps its own space key.
    if (event.key === " " && event.target.closest("button, a, input")) return;
    if (event.target.closest("input[type=text]")) return;
    if (event.key === "Backspace") {
      const undo = document.getElementById("undo");
      if (undo && !sent) {
        event.preventDefault();
        sent = true;
        undo.requestSubmit();
      }
      return;
    }
    const answer = KEYS[event.key];
    const button = answer && answers.querySelector(`button[value=${answer}]`);
    if (button) {
      event.preventDefault();
      answers.requestSubmit(button);
    }
  });

  // Back and forward buttons may show a page that was left: then its answer can be given again.
  window.addEventListener("pageshow", (event) => {
    if (event.persisted) window.location.reload();
  });
})();
