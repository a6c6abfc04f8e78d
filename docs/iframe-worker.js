// Browsers start no worker on a page that was opened from a folder, and the search of the site is one. There
// its script runs in a hidden frame instead. The theme asks for the name IFrameWorker.
"use strict";
if (location.protocol === "file:") {
  class IFrameWorker extends EventTarget {
    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      frame.srcdoc = "<!doctype html>";
      this.running = new Promise((started, failed) => {
        const load = src => new Promise((done, wrong) => {
          const script = frame.contentDocument.createElement("script");
          Object.assign(script, { src, onload: done, onerror: wrong });
          frame.contentDocument.head.append(script);
        });
        frame.addEventListener("load", () => {
          const inside = frame.contentWindow;
          inside.postMessage = data => this.dispatchEvent(new MessageEvent("message", { data }));
          inside.importScripts = (...urls) => urls.reduce((before, src) => before.then(() => load(src)), Promise.resolve());
          load(String(new URL(url, document.baseURI))).then(() => started(inside), failed);
        }, { once: true });
      });
      document.body.append(frame);
    }
    postMessage(data) {
      this.running.then(inside => inside.dispatchEvent(new inside.MessageEvent("message", { data })));
    }
  }
  window.IFrameWorker = window.Worker = IFrameWorker;
}
