// Blobs of recorded.py: base64 of a zlib stream of the header's length, the header, arrays of differences.

/** {header, arrays: name -> {rows, columns, values: Float64Array, row by row}} of a blob. */
export async function unpacked(text) {
  const packed = Uint8Array.from(atob(text), (character) => character.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  const raw = new DataView(await new Response(stream).arrayBuffer());
  const start = 4 + raw.getUint32(0, true);
  const header = JSON.parse(new TextDecoder().decode(new Uint8Array(raw.buffer, 4, start - 4)));
  const arrays = {};
  for (const [name, entry] of Object.entries(header.arrays)) arrays[name] = undone(raw, start, entry);
  return { header, arrays };
}

/** Sums of the differences, times the step: lowest bytes come first, the highest has the sign. */
function undone(raw, start, { at, bytes, rows, columns, step }) {
  const n = rows * columns;
  const values = new Float64Array(n);
  for (let column = 0; column < columns; column++) {
    let sum = 0;
    for (let row = 0; row < rows; row++) {
      const place = start + at + column * rows + row;
      let difference = raw.getInt8(place + (bytes - 1) * n);
      for (let k = bytes - 2; k >= 0; k--) difference = difference * 256 + raw.getUint8(place + k * n);
      sum += difference;
      values[row * columns + column] = sum * step;
    }
  }
  return { rows, columns, values };
}

/** Index of the newest of these times at a moment, -1 before the first. */
export function newest(times, time) {
  let low = 0;
  let high = times.length;
  while (low < high) {
    const middle = (low + high) >> 1;
    if (times[middle] <= time + 1e-6) low = middle + 1;
    else high = middle;
  }
  return low - 1;
}

/** Rows by time: at(time) gives {index, from, to} of the newest moment's rows, null before the first. */
export class Rows {
  constructor(arrays, name) {
    const counts = arrays[`${name}.rows`]?.values ?? [];
    this.times = arrays[`${name}.time`]?.values ?? [];
    this.table = arrays[`${name}.of`] ?? { rows: 0, columns: 1, values: [] };
    this.ends = [];
    let end = 0;
    for (const count of counts) this.ends.push((end += count));
  }

  at(time) {
    const index = newest(this.times, time);
    if (index < 0) return null;
    return { index, from: index ? this.ends[index - 1] : 0, to: this.ends[index] };
  }

  row(i) {
    const { columns, values } = this.table;
    return values.subarray(i * columns, (i + 1) * columns);
  }
}

/** A layer of the map from its changes; going back begins anew. Cells hold 0 to 255. */
export class Layer {
  constructor(arrays, name, cells) {
    this.changes = new Rows(arrays, name);
    this.values = arrays[`${name}.value`]?.values ?? [];
    this.cells = new Uint8Array(cells);
    this.shown = -1;
  }

  /** The cells as of a moment, and as ``shown`` which map of the log that is. */
  at(time) {
    const wanted = newest(this.changes.times, time);
    if (wanted < this.shown) {
      this.cells.fill(0);
      this.shown = -1;
    }
    const { table, ends } = this.changes;
    const from = this.shown < 0 ? 0 : ends[this.shown];
    for (let i = from; i < (wanted < 0 ? 0 : ends[wanted]); i++) this.cells[table.values[i]] = this.values[i];
    this.shown = wanted;
    return this.cells;
  }
}
