// The link to the bridge: the newest sample of every topic, its age, and whether it counts as lost.

const LOST_AFTER_MS = 500; // visualiser/board.py says the same
const SCENE_LOST_AFTER_MS = 2500; // the scene comes once per second only
const BRIDGE_LOST_AFTER_MS = 1500; // without news the bridge answers every 250 ms
const RECONNECT_AFTER_MS = 500;

export const TOPICS = ["state", "status", "command", "plan", "world", "scene"];

export class Link {
  /** @param onNews called with (topic, sample, arrivedMs) for every new sample. */
  constructor(onNews) {
    this.onNews = onNews;
    this.samples = {};
    this.messages = 0;
    this.rejected = 0;
    this.news = {}; // per topic: age at arrival and time of arrival [ms]
    this.lastFrameMs = -Infinity;
    this.connect();
  }

  connect() {
    const socket = new WebSocket(`ws://${location.host}/ws`);
    const ask = () => socket.send("next"); // the bridge sends one frame per request, so that nothing piles up
    socket.onopen = ask;
    socket.onmessage = (event) => {
      this.take(JSON.parse(event.data));
      ask();
    };
    socket.onclose = () => setTimeout(() => this.connect(), RECONNECT_AFTER_MS);
  }

  take(frame) {
    const now = performance.now();
    this.lastFrameMs = now;
    this.rejected = frame.rejected;
    for (const [topic, { age_ms: ageMs, sample }] of Object.entries(frame.topics)) {
      this.messages += 1;
      this.samples[topic] = sample;
      this.news[topic] = { ageMs, arrivedMs: now };
      this.onNews(topic, sample, now);
    }
  }

  /** Age of a topic [ms]; null when nothing has come yet. */
  ageMs(topic, now = performance.now()) {
    const news = this.news[topic];
    return news ? news.ageMs + now - news.arrivedMs : null;
  }

  isLost(topic, now = performance.now()) {
    const ageMs = this.ageMs(topic, now);
    return ageMs !== null && ageMs > (topic === "scene" ? SCENE_LOST_AFTER_MS : LOST_AFTER_MS);
  }

  /** The sample of a topic unless it is lost. */
  fresh(topic, now = performance.now()) {
    return this.isLost(topic, now) ? undefined : this.samples[topic];
  }

  lostTopics(now = performance.now()) {
    return TOPICS.filter((topic) => this.isLost(topic, now));
  }

  isBridgeLost(now = performance.now()) {
    return now - this.lastFrameMs > BRIDGE_LOST_AFTER_MS;
  }
}
