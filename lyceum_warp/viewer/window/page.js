// Adapts studio's page: adds the secret path to its absolute paths, gives control to the visible tab, shows links to new
// files and what a policy sees, and sends a gamepad's axes.
{
  const path = location.pathname;
  const below = (address) => {
    const url = new URL(address, document.baseURI);
    if (!url.pathname.startsWith(path)) url.pathname = path + url.pathname.slice(1);
    return url.href;
  };
  const original = fetch;
  window.fetch = (address, options) => original(below(address), options);

  const theme = () => {
    const preferred = matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
    try {
      return (localStorage.mjwv_theme ??= preferred);
    } catch {
      return preferred;
    }
  };
  theme();

  let state = null;  // the WebSocket of studio's session
  const visible = () => document.visibilityState === "visible";
  const say = (text) => state?.readyState === WebSocket.OPEN && state.send(text);
  const take = () => visible() && say("force_control");
  document.addEventListener("visibilitychange", take);
  window.addEventListener("focus", take);

  window.WebSocket = class extends WebSocket {
    constructor(address, protocols = []) {
      super(below(address), protocols);
      if (!new URL(this.url).pathname.endsWith("/state")) return;
      state = this;
      this.addEventListener("open", take);
      this.addEventListener("message", (event) => {
        if (typeof event.data !== "string") return;
        if (visible() && event.data.includes("role=spectator;queue_pos=0")) say("request_control");
        if (event.data.includes("role=controller")) say("theme=" + theme());  // studio's page may say it too early
        const [kind, text] = event.data.split(/=(.*)/s);
        if (kind !== "saved" && kind !== "copy" && kind !== "pictures") return;
        event.stopImmediatePropagation();
        if (kind === "pictures") show(JSON.parse(text));
        else if (kind === "saved") offer("\u2b07 " + text, {href: "saved/" + text, download: text});
        else offer("copy: " + text, {href: "#", onclick: () => navigator.clipboard.writeText(text) && false});
      });
    }
  };

  const offer = (text, properties) => {
    const box = document.getElementById("saved") ?? document.body.appendChild(document.createElement("div"));
    box.id = "saved";
    box.style = "position:fixed;right:12px;bottom:44px;max-width:60%;padding:8px;background:#fffd;font:14px sans-serif";
    const link = Object.assign(document.createElement("a"), {textContent: text, ...properties});
    link.style = "display:block;color:#06c";
    box.append(link);
    while (box.children.length > 4) box.firstChild.remove();
  };

  // what a policy sees
  const show = (pictures) => {
    const box = document.getElementById("pictures") ?? document.body.appendChild(document.createElement("div"));
    box.id = "pictures";
    box.style = "position:fixed;top:60px;left:50%;transform:translateX(-50%);display:flex;gap:8px;pointer-events:none";
    box.replaceChildren(...pictures.map(([caption, src]) => {
      const figure = document.createElement("figure");
      figure.style = "margin:0;padding:4px;width:min-content;background:#fffd;color:#000;font:12px sans-serif";
      const style = "display:block;height:min(20vh,160px);image-rendering:pixelated";
      const image = Object.assign(new Image(), {src, style});
      figure.append(image, caption);
      return figure;
    }));
  };

  // a gamepad's left stick moves a walking robot, and its right stick turns it
  let axes = "0,0,0";
  const steer = () => {
    const pad = visible() && navigator.getGamepads().find(Boolean);
    if (!pad) return;
    const [x, y, turn] = pad.axes.map((axis) => (Math.abs(axis) < 0.15 ? 0 : -axis.toFixed(1)));
    const now = [y, x, turn].join();
    if (now !== axes) say("gamepad=" + (axes = now));
  };
  window.addEventListener("gamepadconnected", () => setInterval(steer, 50), {once: true});

  // studio would replace the title
  Object.defineProperty(document, "title", {get: () => document.querySelector("title").text, set: () => {}});
}
