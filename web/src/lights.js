// The strip of lights: a thumbnail for each, and a slider that runs from the first to the last. Where the lights are
// those of a day in order, playing passes the day.

const GLIDE = 700; // milliseconds from one light to another
const STAY = 900; // milliseconds at each while playing
const DAY = 10_000; // milliseconds of a day

/** Shows which light is on, and changes it. */
export class Lights {
  constructor({ strip, slider, play }, lights, day, blend) {
    this.slider = slider;
    this.play = play;
    this.blend = blend;
    this.count = lights.length;
    this.animation = 0;
    this.buttons = lights.map((light, index) => this.button(light, index));
    strip.replaceChildren(...this.buttons);
    slider.max = String(this.count - 1);
    slider.addEventListener("input", () => this.set(Number(slider.value)));
    play.addEventListener("click", () => (this.playing ? this.stop() : day ? this.passDay() : this.tour()));
    if (day) {
      play.textContent = "Day";
      play.title = "A day in ten seconds";
      slider.setAttribute("aria-label", "Time of day");
    }
    slider.hidden = play.hidden = this.count < 2;
    this.set(0);
  }

  button(light, index) {
    const button = document.createElement("button");
    const image = document.createElement("img");
    const name = document.createElement("span");
    image.src = light.thumbnail;
    image.alt = "";
    name.textContent = light.name;
    button.type = "button";
    button.title = light.name;
    button.append(image, name);
    button.addEventListener("click", () => {
      this.stop();
      this.glide(index);
    });
    return button;
  }

  /** Shows a place on the slider: 0 is the first light, 1 the second, 0.5 half of each. */
  set(value) {
    this.stop();
    this.place(value);
  }

  place(value) {
    const place = Math.min(this.count - 1, Math.max(0, value));
    const from = Math.min(Math.floor(place), Math.max(0, this.count - 2));
    this.show(from, Math.min(from + 1, this.count - 1), place - from, place);
  }

  show(from, to, amount, place) {
    this.value = place;
    this.slider.value = String(place);
    this.buttons.forEach((button, index) => {
      const share = (index === from ? 1 - amount : 0) + (index === to ? amount : 0);
      button.style.setProperty("--share", share.toFixed(3));
      button.setAttribute("aria-pressed", String(share > 0.5));
    });
    this.blend(from, to, amount);
  }

  /** Goes over to a light: straight from the one that is on, or along the slider from between two. */
  glide(target, then = () => {}) {
    const start = this.value;
    const from = Math.round(start);
    const between = Math.abs(start - from) > 0.01;
    const began = performance.now();
    const step = (now) => {
      const time = Math.min(1, Math.max(0, (now - began) / GLIDE));
      const amount = time * time * (3 - 2 * time);
      const place = start + (target - start) * amount;
      if (between || time === 1) this.place(place);
      else this.show(from, target, amount, place);
      if (time < 1) this.animation = requestAnimationFrame(step);
      else then();
    };
    this.animation = requestAnimationFrame(step);
  }

  /** One light after the other, until stopped. */
  tour() {
    this.playing = true;
    this.play.setAttribute("aria-pressed", "true");
    const next = () => {
      this.glide((Math.round(this.value) + 1) % this.count, () => (this.pause = setTimeout(next, STAY)));
    };
    next();
  }

  /** From the light that is on to the end of the day, then from its beginning, until stopped. */
  passDay() {
    this.playing = true;
    this.play.setAttribute("aria-pressed", "true");
    const last = this.count - 1;
    let before = performance.now();
    const step = (now) => {
      const next = this.value + (Math.max(0, now - before) / DAY) * last;
      before = now;
      this.place(this.value >= last ? 0 : next);
      this.animation = requestAnimationFrame(step);
    };
    this.animation = requestAnimationFrame(step);
  }

  stop() {
    cancelAnimationFrame(this.animation);
    clearTimeout(this.pause);
    this.playing = false;
    this.play.setAttribute("aria-pressed", "false");
  }
}
