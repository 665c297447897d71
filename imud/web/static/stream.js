// WebSocket to imud web. A hidden page requests nothing.

const RETRY_FIRST_MS = 500;
const RETRY_MOST_MS = 5000;
const ACKNOWLEDGE_MS = 250;

export class Stream {
  constructor(onMessage, onLink, mayRead) {
    this.mayRead = mayRead;
    this.onMessage = onMessage;
    this.onLink = onLink;
    this.wish = { look: "nothing" };
    this.handled = 0;
    this.retry = RETRY_FIRST_MS;
    document.addEventListener("visibilitychange", () => this.send());
    setInterval(() => this.handled && this.send(), ACKNOWLEDGE_MS);
  }

  connect() {
    if (!this.mayRead()) {
      setTimeout(() => this.connect(), RETRY_FIRST_MS);
      return;
    }
    const scheme = location.protocol === "https:" ? "wss:" : "ws:";
    const socket = new WebSocket(`${scheme}//${location.host}/api/stream`);
    this.socket = socket;
    socket.onopen = () => {
      this.retry = RETRY_FIRST_MS;
      this.handled = 0;
      this.onLink(true);
      this.send();
    };
    socket.onmessage = (event) => {
      this.handled += 1;
      this.onMessage(JSON.parse(event.data));
    };
    socket.onclose = () => {
      this.onLink(false);
      setTimeout(() => this.connect(), this.retry);
      this.retry = Math.min(2 * this.retry, RETRY_MOST_MS);
    };
  }

  /** Change the view: a message `Look` of imud/web/messages.py. */
  look(wish) {
    this.wish = wish;
    this.send();
  }

  send() {
    if (this.socket?.readyState !== WebSocket.OPEN) return;
    const wish = document.hidden ? { ...this.wish, look: "nothing" } : this.wish;
    this.socket.send(JSON.stringify({ ...wish, acknowledged: this.handled }));
    this.handled = 0;
  }
}
