// State that all views share.

export const session = { read: false, control: false, has_token: false, version: "" };

/** The newest `overview` of imud/web/messages.py. */
export const world = { now_s: 0, clients: 0, devices: [], isKnown: false };

const KEY = "imud-edits";
/** Edits of settings: by device, then by setting. */
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
