// The live state: what the observer sent last, merged, and how old it is.

const STALE_MS = 4000,
  RETRY_MS = [500, 1000, 2000, 5000],
  HIDDEN_MS = 60000,
  EVENTS_KEPT = 3000,
  USES_KEPT = 500;
export const USES = new Set(["use_began", "use_ended"]);
const PROBLEMS = {
  401: "the token is refused: open /?token=TOKEN once",
  503: "too many pages are open",
  502: "the arbiter is not reached",
  421: "this name is refused",
  403: "refused",
};

export class Feed {
  constructor(changed) {
    Object.assign(this, {
      changed,
      status: null,
      leases: new Map(),
      waits: new Map(),
      samples: new Map(),
      events: [],
      lastSeq: 0,
      receivedAt: 0,
      heardAt: null,
      heardWall: null,
      problem: "",
      tries: 0,
      live: false,
      historyProblem: "",
    });
    document.addEventListener("visibilitychange", () => this.seen());
    setInterval(() => this.watch(), 500);
    this.connect();
  }

  connect() {
    clearTimeout(this.timer);
    this.source?.close();
    const source = (this.source = new EventSource("/events"));
    const on = (name, take) =>
      source.addEventListener(name, (event) => {
        if (this.source !== source) return;
        this.heard();
        take.call(this, JSON.parse(event.data));
        this.changed(name);
      });
    on("snapshot", this.snapshot);
    on("page", (page) => this.add(page.leases));
    on("waits", (told) => {
      this.waits = new Map(
        told.waits.map((one) => [one.lease_id, { ...one, at: performance.now() }]),
      );
    });
    on("usage", this.usage);
    on("history", (reply) => this.history(reply));
    source.onerror = () => {
      if (this.source === source) this.lost();
    };
  }

  lost() {
    this.source?.close();
    this.source = null;
    this.live = false;
    const wait = RETRY_MS[Math.min(this.tries, RETRY_MS.length - 1)];
    this.tries += 1;
    this.timer = setTimeout(() => this.connect(), wait);
    // an event source does not tell why it was refused
    fetch("/events", { method: "HEAD", cache: "no-store" }).then(
      (reply) => {
        this.problem = PROBLEMS[reply.status] ?? "";
        this.changed("link");
      },
      () => {
        this.problem = "";
        this.changed("link");
      },
    );
    this.changed("link");
  }

  heard() {
    Object.assign(this, {
      heardAt: performance.now(),
      heardWall: Date.now() / 1000,
      tries: 0,
      problem: "",
      live: true,
    });
  }

  // A daemon that is stopped or gone says so by its silence.
  watch() {
    if (this.live && performance.now() - this.heardAt > STALE_MS) {
      this.live = false;
      this.changed("link");
    }
  }

  // A page in the background asks for nothing.
  seen() {
    clearTimeout(this.hiding);
    if (document.hidden) {
      this.hiding = setTimeout(() => {
        clearTimeout(this.timer);
        this.source?.close();
        this.source = null;
        this.live = false;
      }, HIDDEN_MS);
    } else if (!this.source) this.connect();
  }

  snapshot(status) {
    this.leases = new Map();
    // times of another start of the daemon
    if (status.epoch !== this.status?.epoch) this.samples = new Map();
    this.status = status;
    this.receivedAt = performance.now();
    this.add(status.leases);
  }

  add(leases) {
    const now = performance.now();
    for (const lease of leases) {
      this.leases.set(lease.lease_id, {
        ...lease,
        at: now - 1000 * lease.since_s,
        askedAt: now - 1000 * (lease.waited_s ?? 0),
      });
    }
  }

  usage(told) {
    for (const [at, gpu, used, parts] of told.samples) {
      if (!this.samples.has(gpu)) this.samples.set(gpu, []);
      const list = this.samples.get(gpu);
      if (list.length && list[list.length - 1].at >= at) continue;
      list.push({
        at,
        used,
        parts: parts.map(([part, count]) => [part < 0 ? part : told.consumers[part], count]),
      });
    }
    for (const list of this.samples.values()) {
      while (list.length > 1 && list[1].at < this.uptime - told.kept_s) list.shift();
    }
  }

  history(reply, older = false) {
    this.historyProblem = reply.problem ?? "";
    const arrivedAt = older || !this.events.length ? null : performance.now();
    const known = new Set(this.events.map((event) => event.seq));
    const fresh = reply.events
      .filter((event) => !known.has(event.seq))
      .map((event) => ({ ...event, arrivedAt }));
    if (!fresh.length) return fresh;
    this.events = [...this.events, ...fresh].sort((a, b) => a.seq - b.seq);
    if (!older) this.forget();
    return fresh;
  }

  get firstSeq() {
    return this.events.length ? this.events[0].seq : 0;
  }

  // Uses are many and soon of no interest.
  forget() {
    let uses = this.events.reduce((sum, event) => sum + USES.has(event.kind), 0) - USES_KEPT;
    let more = this.events.length - EVENTS_KEPT;
    if (uses <= 0 && more <= 0) return;
    this.events = this.events.filter((event) => {
      const drop = (USES.has(event.kind) && uses-- > 0) || more > 0;
      more -= drop;
      return !drop;
    });
  }

  // Pages back until some events fit; numbers have gaps, since a crash skips some.
  async loadOlder(fits) {
    let before = this.before ?? this.firstSeq,
      found = 0;
    for (let pages = 0; before > 1 && pages < 20 && found < 20; pages += 1) {
      const after = Math.max(0, before - 201);
      const reply = await fetch(`/history?after=${after}&limit=${before - after - 1}`, {
        cache: "no-store",
      });
      if (!reply.ok) break;
      found += this.history(await reply.json(), true).filter(fits).length;
      before = this.before = after + 1;
    }
    this.oldest = before <= 1;
    this.changed("history");
  }

  // Seconds of the daemon's uptime now; they stand still while it is not heard.
  get uptime() {
    if (!this.status) return 0;
    return this.status.uptime_s + (this.live ? (performance.now() - this.receivedAt) / 1000 : 0);
  }

  get now() {
    return this.live || this.heardAt === null ? performance.now() : this.heardAt;
  }
}
