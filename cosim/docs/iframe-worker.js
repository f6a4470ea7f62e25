// A page opened from a file may not start workers: the search runs in a hidden frame instead, with the same messages.
if (location.protocol === "file:") {
  window.IFrameWorker = class extends EventTarget {
    constructor(url) {
      super()
      this.frame = document.createElement("iframe")
      this.frame.hidden = true
      document.body.appendChild(this.frame)
      const inner = this.frame.contentWindow
      this.loaded = new Promise(done => {
        inner.document.open()
        inner.document.write("<!doctype html><html><body></body></html>")
        inner.document.close()
        inner.postMessage = data => this.dispatchEvent(new MessageEvent("message", { data }))
        inner.importScripts = (...urls) => urls.reduce((before, one) => before.then(() => load(one)), Promise.resolve())
        const load = src => new Promise((found, missing) => {
          const script = inner.document.createElement("script")
          Object.assign(script, { src, onload: found, onerror: missing })
          inner.document.body.appendChild(script)
        })
        load(url).then(done)
      })
    }
    postMessage(data) {
      this.loaded.then(() => this.frame.contentWindow.dispatchEvent(new MessageEvent("message", { data })))
    }
    terminate() {
      this.frame.remove()
    }
  }
  window.Worker = window.IFrameWorker
}
