// A button on each block of code copies it.
for (const block of document.querySelectorAll("div.highlight")) {
  const button = document.createElement("button");
  button.className = "copy";
  button.textContent = "copy";
  button.onclick = async () => {
    await navigator.clipboard.writeText(block.querySelector("pre").textContent.trimEnd());
    button.textContent = "copied";
    setTimeout(() => (button.textContent = "copy"), 1500);
  };
  block.append(button);
}

// A still picture is replaced by the animation while it is seen, except for those who prefer reduced motion.
const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
const seen = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) {
    target.previousElementSibling.media = isIntersecting ? "not all" : "all";
  }
});
if (!calm) for (const still of document.querySelectorAll("picture > source")) seen.observe(still.nextElementSibling);

// Over a robot, the wheel scrolls the page, and zooms with Ctrl. The robot stands still for those who prefer that.
const prepare = (frame) => {
  const button = frame.contentDocument?.querySelector("canvas ~ form button");
  if (!button) return;
  frame.contentWindow.addEventListener("wheel", (e) => e.ctrlKey || e.stopImmediatePropagation(), true);
  const stop = () => button.textContent === "pause" && (button.click(), setTimeout(stop, 100)); // its script may load
  if (calm) stop();
};
for (const frame of document.querySelectorAll("iframe")) {
  frame.addEventListener("load", () => prepare(frame));
  if (frame.contentDocument?.readyState === "complete") prepare(frame);
}

// A robot that is unfolded scrolls into view.
for (const fold of document.querySelectorAll("details.turnable")) {
  fold.addEventListener("toggle", () => fold.open && fold.scrollIntoView({ block: "nearest" }));
}

// Folds around a link's target open.
const unfold = () => {
  const target = document.getElementById(decodeURIComponent(location.hash.slice(1)));
  for (let fold = target?.closest("details"); fold; fold = fold.parentElement.closest("details")) fold.open = true;
  target?.scrollIntoView();
};
addEventListener("hashchange", unfold);
if (location.hash) unfold();
