// Browsers start no worker from a file. In its place a hidden frame runs the same script, so that the built pages are
// searched without a server. The theme's script looks for the frame by this name.
window.IFrameWorker = class extends EventTarget {
  constructor(url) {
    super();
    this.frame = document.createElement("iframe");
    this.frame.hidden = true;
    document.body.append(this.frame);
    this.ready = new Promise((resolve) => {
      const page = this.frame.contentWindow;
      window.addEventListener("message", ({ source, data }) => {
        if (source !== page) return;
        const message = new MessageEvent("message", { data });
        this.dispatchEvent(message);
        this.onmessage?.(message);
      });
      const first = `
        postMessage = (data) => parent.postMessage(data, "*");
        importScripts = (...urls) => urls.reduce((before, src) => before.then(() => new Promise((loaded) =>
          document.body.append(Object.assign(document.createElement("script"), { src, onload: loaded })))),
          Promise.resolve());`;
      page.document.open();
      page.document.write(`<body><script>${first}<\/script><script src="${url}"><\/script></body>`);
      page.onload = resolve;
      page.document.close();
    });
  }

  postMessage(data) {
    this.ready.then(() => this.frame.contentWindow.dispatchEvent(new MessageEvent("message", { data })));
  }

  terminate() {
    this.frame.remove();
  }
};
if (location.protocol === "file:") window.Worker = window.IFrameWorker;
