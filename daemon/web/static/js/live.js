// The live state: one stream of events, reopened whenever it breaks, and the age of the data shown.

const SILENT_MS = 2000; // after this time without an event the data shown are not live
const REOPEN_MS = 5000; // after this time without an event the stream is reopened
const RETRY_MS = 1000;

export class Live {
  /** @param {{onState: Function, onRefused: Function}} listeners */
  constructor({ onState, onRefused }) {
    this.state = null;
    this.receivedAt = -Infinity; // time of the last state of the daemon
    this.heardAt = performance.now(); // time of the last event
    this.trouble = "connecting";
    this.onState = onState;
    this.onRefused = onRefused;
    this.timer = setInterval(() => this.look(), 250);
    addEventListener("online", () => this.open());
    addEventListener("offline", () => this.lose("this tablet has no network"));
    document.addEventListener("visibilitychange", () => { if (!document.hidden && !this.isLive) this.open(); });
    this.open();
  }

  /** True if the data shown are current. */
  get isLive() { return this.trouble === null; }

  /** Seconds since the last state arrived. */
  get age() { return (performance.now() - this.receivedAt) / 1000; }

  open() {
    this.source?.close();
    clearTimeout(this.again);
    this.heardAt = performance.now();
    this.source = new EventSource("/api/live");
    this.source.addEventListener("message", (event) => this.take(JSON.parse(event.data)));
    this.source.addEventListener("error", () => {
      this.source.close();
      this.lose("the connection to the rig is lost");
      this.again = setTimeout(() => this.retry(), RETRY_MS);
    });
  }

  async retry() {
    try {
      const response = await fetch("/api/me", { credentials: "same-origin" });
      if (response.ok && (await response.json()).role === null) { this.onRefused(); return; }
    } catch { /* still lost: the stream reports it */ }
    this.open();
  }

  take(message) {
    this.heardAt = performance.now();
    if (message.daemon !== null) { this.lose(`the daemon does not answer: ${message.daemon}`); return; }
    this.receivedAt = this.heardAt;
    this.state = message;
    this.trouble = null;
    this.onState();
  }

  lose(trouble) {
    this.trouble = trouble;
    this.onState();
  }

  look() {
    const silent = performance.now() - this.heardAt;
    if (silent > SILENT_MS) this.lose(this.trouble ?? "the connection to the rig is lost");
    if (silent > REOPEN_MS) this.open();
  }

  /** Present age, in real seconds, of data that were `age` seconds old on the daemon's clock when the state was made. */
  ageOf(age) {
    if (age === null || age === undefined) return null;
    return age * (this.state?.time.real_s_per_s || 1) + this.age;
  }
}
