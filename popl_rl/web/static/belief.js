// Bars of belief move from where they were before the last answer.
"use strict";
for (const bar of document.querySelectorAll(".belief rect")) {
  const now = bar.getAttribute("width");
  bar.setAttribute("width", bar.dataset.before);
  window.requestAnimationFrame(() =>
    window.requestAnimationFrame(() => bar.setAttribute("width", now)),
  );
}
