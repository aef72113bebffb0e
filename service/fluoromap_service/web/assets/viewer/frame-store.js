/** Frames of all runs of the page in one place. What was not used for long is dropped, so that memory stays bounded. */
export const MOST_BYTES = 192 * 2 ** 20;

/** @type {Map<string, Uint8Array>} Address -> frames; the order is that of the last use. */
const parts = new Map();

/** Return the frames of an address, null when they are not here. @param {string} address */
export function takePart(address) {
  const found = parts.get(address);
  if (!found) return null;
  parts.delete(address);
  parts.set(address, found);
  return found;
}

/** @param {string} address */
export const hasPart = (address) => parts.has(address);

/** @param {string} address @param {Uint8Array} content */
export function storePart(address, content) {
  parts.set(address, content);
  let bytes = storedBytes();
  for (const [oldest, each] of parts) {
    if (bytes <= MOST_BYTES || parts.size === 1) break;
    parts.delete(oldest);
    bytes -= each.length;
  }
}

/** Bytes of the frames that are here: at most MOST_BYTES, unless one part is larger. */
export function storedBytes() {
  let bytes = 0;
  for (const each of parts.values()) bytes += each.length;
  return bytes;
}
