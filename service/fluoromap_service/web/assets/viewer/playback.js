/** Pace of a run that states none, ms. */
export const FRAME_MS = 66;

/** The time of a run that plays: calls back with each frame that is due, and leaves frames out where the browser is late. */
export class Playback {
  /** @param {number} frameMs @param {(frames: number) => void} onFrames Called with the number of frames to go forward. */
  constructor(frameMs, onFrames) {
    this.frameMs = frameMs;
    this.onFrames = onFrames;
    this.playing = false;
  }

  /** @param {boolean} playing */
  play(playing) {
    if (playing === this.playing) return;
    this.playing = playing;
    let last = performance.now();
    /** @param {number} now */
    const step = (now) => {
      if (!this.playing) return;
      const frames = Math.floor((now - last) / this.frameMs);
      if (frames > 0) {
        last += frames * this.frameMs;
        this.onFrames(frames);
      }
      requestAnimationFrame(step);
    };
    if (playing) requestAnimationFrame(step);
  }
}
