// Browsers start no worker from a file. On pages that are opened from a disk the search of the site
// therefore runs in a hidden frame, which answers to what a worker answers to.
if (location.protocol === "file:") {
  // The theme looks for this name, and fetches such a worker from the network where it is missing.
  window.IFrameWorker = window.Worker = class extends EventTarget {
    constructor(url) {
      super()
      this.onmessage = null
      this.frame = document.createElement("iframe")
      this.frame.hidden = true
      document.body.append(this.frame)
      const inside = this.frame.contentWindow
      inside.document.open()
      inside.document.write("<!doctype html><body>")
      inside.document.close()
      const run = (source) =>
        new Promise((resolve, reject) => {
          const script = inside.document.createElement("script")
          script.onload = resolve
          script.onerror = () => reject(new Error(`${source} cannot be loaded`))
          script.src = source
          inside.document.body.append(script)
        })
      inside.postMessage = (data) => {
        const event = new MessageEvent("message", { data })
        this.dispatchEvent(event)
        this.onmessage?.(event)
      }
      inside.importScripts = async (...sources) => {
        for (const source of sources) await run(source)
      }
      this.started = run(url)
    }

    postMessage(data) {
      const { MessageEvent } = this.frame.contentWindow
      this.started.then(() =>
        this.frame.contentWindow.dispatchEvent(new MessageEvent("message", { data: structuredClone(data) })),
      )
    }

    terminate() {
      this.frame.remove()
    }
  }
}
