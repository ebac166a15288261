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

// Over a robot, the wheel scrolls the page, and zooms with Ctrl; the robot stands still for those who prefer that.
const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
const prepare = (frame) => {
  if (frame.contentDocument?.querySelector("canvas") === null || !frame.contentDocument) return;
  frame.contentWindow.addEventListener("wheel", (e) => e.ctrlKey || e.stopImmediatePropagation(), true);
  if (calm) frame.contentDocument.querySelector("button").click();
};
for (const frame of document.querySelectorAll("iframe")) {
  frame.addEventListener("load", () => prepare(frame));
  if (frame.contentDocument?.readyState === "complete") prepare(frame);
}
