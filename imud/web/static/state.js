// State that all views share: the session, the devices, and edits of settings that exist only in this browser.

export const session = { read: false, control: false, has_token: false, version: "" };

/** The newest `overview` of imud/web/messages.py. */
export const world = { now_s: 0, clients: 0, devices: [], isKnown: false };

export const deviceRow = (name) => world.devices.find((one) => one.name === name);

const KEY = "imud-edits";
/** Edits of settings: by device, then by setting. sessionStorage keeps them during a reload. */
export const edits = new Map();
try {
  for (const [device, values] of Object.entries(JSON.parse(sessionStorage.getItem(KEY) ?? "{}"))) edits.set(device, new Map(Object.entries(values)));
} catch {
  edits.clear();
}

export function editsOf(device) {
  if (!edits.has(device)) edits.set(device, new Map());
  return edits.get(device);
}

export function keepEdits() {
  const found = Object.fromEntries([...edits].filter(([, values]) => values.size).map(([device, values]) => [device, Object.fromEntries(values)]));
  try {
    sessionStorage.setItem(KEY, JSON.stringify(found));
  } catch {
    // without storage, the edits end with the page
  }
  document.dispatchEvent(new CustomEvent("edits"));
}
