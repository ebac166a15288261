// Adapts studio's page: adds the secret path to its absolute paths, gives control to the visible tab, and shows links
// to new files.
{
  const path = location.pathname;
  const below = (address) => {
    const url = new URL(address, document.baseURI);
    if (!url.pathname.startsWith(path)) url.pathname = path + url.pathname.slice(1);
    return url.href;
  };
  const original = fetch;
  window.fetch = (address, options) => original(below(address), options);

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
        if (event.data.startsWith("saved=")) {
          event.stopImmediatePropagation();
          offer(event.data.slice(6));
        }
      });
    }
  };

  const offer = (name) => {
    const box = document.getElementById("saved") ?? document.body.appendChild(document.createElement("div"));
    box.id = "saved";
    box.style = "position:fixed;right:12px;bottom:44px;padding:8px;background:#fffd;font:14px sans-serif";
    const link = document.createElement("a");
    Object.assign(link, {href: "saved/" + name, download: name, textContent: "\u2b07 " + name});
    link.style = "display:block;color:#06c";
    box.append(link);
    while (box.children.length > 4) box.firstChild.remove();
  };

  // studio would replace the title
  Object.defineProperty(document, "title", {get: () => document.querySelector("title").text, set: () => {}});
  try {
    localStorage.mjwv_theme ??= matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light";
  } catch {}
}
