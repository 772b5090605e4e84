// A film as a file: pictures that the browser encodes, in one MP4 (ISO/IEC 14496-12, -14 and -15).

const RATE = 30; // pictures a second
const TICKS = 600; // of the file's clock, a second
const CODEC = { codec: "avc1.64001f", bitrate: 4e6, framerate: RATE, avc: { format: "avc" } };
const AT_ONCE = 30; // pictures that wait in the encoder

// The film at RATE in `length` seconds, as bytes; `drawn` is called with the share that is done.
async function encoded(film, length, drawn) {
  const samples = [];
  let [description, problem] = [null, null];
  const encoder = new VideoEncoder({
    output: (chunk, more) => {
      const data = new Uint8Array(chunk.byteLength);
      chunk.copyTo(data);
      samples.push({ key: chunk.type === "key", data });
      const told = more?.decoderConfig?.description;
      if (told) description = new Uint8Array(told.buffer ?? told);
    },
    error: (raised) => { problem = raised; },
  });
  const [width, height] = film.size;
  encoder.configure({ ...CODEC, width, height });
  const count = Math.round(length * RATE);
  for (let i = 0; i < count; i++) {
    film.draw((i / count) * film.seconds);
    const timestamp = Math.round((1e6 * i) / RATE);
    const picture = new VideoFrame(CANVAS, { timestamp });
    encoder.encode(picture, { keyFrame: i % (2 * RATE) === 0 });
    picture.close();
    if ((i + 1) % AT_ONCE && i + 1 < count) continue;
    await encoder.flush();
    if (problem) throw problem;
    drawn((i + 1) / count);
    await new Promise((resume) => setTimeout(resume)); // the page shows how far it is
  }
  encoder.close();
  return mp4(samples, description, film.size);
}

function mp4(samples, description, size) {
  const head = box("ftyp", "isom", [512], "isomiso2avc1mp41");
  // The track contains the place of its pictures, which depends on the track's length.
  const length = head.length + track(samples, description, size, 0).length;
  const data = samples.map((sample) => sample.data);
  return bytes(head, track(samples, description, size, length + 8), box("mdat", ...data));
}

function track(samples, description, [width, height], offset) {
  const ticks = TICKS / RATE;
  const duration = ticks * samples.length;
  const matrix = [0x10000, 0, 0, 0, 0x10000, 0, 0, 0, 0x40000000];
  const zeros = (count) => new Uint8Array(count);
  const video = box("avc1", zeros(6), short(1), zeros(16), short(width, height),
    [0x480000, 0x480000, 0], short(1), zeros(32), short(24, 0xffff), box("avcC", description));
  const keys = samples.flatMap((sample, i) => (sample.key ? [i + 1] : []));
  const table = box("stbl",
    box("stsd", [0, 1], video),
    box("stts", [0, 1, samples.length, ticks]),
    box("stss", [0, keys.length, ...keys]),
    box("stsc", [0, 1, 1, samples.length, 1]),
    box("stsz", [0, 0, samples.length, ...samples.map((sample) => sample.data.length)]),
    box("stco", [0, 1, offset]));
  const media = box("minf", box("vmhd", [1, 0, 0]),
    box("dinf", box("dref", [0, 1], box("url ", [1]))), table);
  return box("moov",
    box("mvhd", [0, 0, 0, TICKS, duration, 0x10000], short(0x100), zeros(10), matrix, zeros(24), [2]),
    box("trak",
      box("tkhd", [3, 0, 0, 1, 0, duration], zeros(16), matrix, [width << 16, height << 16]),
      box("mdia",
        box("mdhd", [0, 0, 0, TICKS, duration], short(0x55c4, 0)), // language: undetermined
        box("hdlr", [0, 0], "vide", zeros(12), "film\0"),
        media)));
}

function box(kind, ...parts) {
  const content = bytes(...parts);
  return bytes([content.length + 8], kind, content);
}

// Texts, 32-bit numbers in lists, and bytes, one after the other.
function bytes(...parts) {
  const each = parts.map((part) => {
    if (typeof part === "string") return Uint8Array.from(part, (letter) => letter.charCodeAt(0));
    if (!Array.isArray(part)) return part;
    const view = new DataView(new ArrayBuffer(4 * part.length));
    part.forEach((value, i) => view.setUint32(4 * i, value));
    return new Uint8Array(view.buffer);
  });
  const all = new Uint8Array(each.reduce((sum, part) => sum + part.length, 0));
  let at = 0;
  for (const part of each) {
    all.set(part, at);
    at += part.length;
  }
  return all;
}

function short(...values) {
  return Uint8Array.from(values.flatMap((value) => [value >> 8, value & 255]));
}

// The button that saves the film; only where the browser can encode (a page of this machine, or
// https).
function offer(film) {
  const button = document.querySelector("button.save");
  if (!window.VideoEncoder) return;
  button.hidden = false;
  button.onclick = async () => {
    film.stop();
    button.disabled = true;
    try {
      const share = (done) => { button.textContent = `${Math.round(100 * done)} %`; };
      const made = await encoded(film, film.seconds, share);
      const link = document.createElement("a");
      link.href = URL.createObjectURL(new Blob([made], { type: "video/mp4" }));
      link.download = `${document.title}.mp4`;
      link.click();
      URL.revokeObjectURL(link.href);
      button.textContent = "MP4";
    } catch (problem) {
      button.textContent = "no MP4";
      button.title = `this browser cannot encode it: ${problem.message}`;
    }
    button.disabled = false;
  };
}
