// Two devices on one time axis.

import { el } from "./util.js";

export class Compare {
  constructor(main, stream) {
    main.append(el("div", { class: "device-head" }, el("h1", { text: "Compare" })), el("p", { class: "help", text: "Not available yet." }));
    stream.look({ look: "overview" });
  }

  onMessage() {}

  close() {}
}
