// Draws the replay on the home page; `sitegen/replay.py` writes what it draws.
(() => {
  const home = document.getElementById("replay"), data = window.coopenvReplay;
  if (!home || !data) return;
  const numbers = text => {
    const bytes = Uint8Array.from(atob(text), c => c.charCodeAt(0));
    return Array.from(new Int16Array(bytes.buffer));
  };
  const count = data.colours.length, truth = numbers(data.truth), variants = {};
  for (const [name, parts] of Object.entries(data.variants))
    variants[name] = { estimate: numbers(parts.estimate), sight: numbers(parts.sight), lost: numbers(parts.lost) };
  const observers = [...new Set(Object.keys(variants).map(name => name.split("/")[0]))];
  const broken = [...new Set(Object.keys(variants).map(name => +name.split("/")[1]))];
  let observer = observers[0], camera = -1, at = 0, playing = true, before = null;

  const add = (parent, tag, look = {}) => parent.appendChild(Object.assign(document.createElement(tag), look));
  const verdict = add(home, "div", { className: "verdict" });
  const canvas = add(home, "canvas");
  const bar = add(home, "div", { className: "bar" });
  const play = add(bar, "button", { textContent: "Pause", onclick: () => start(!playing) });
  const time = add(bar, "input", { type: "range", min: 0, max: data.frames - 1, step: 1, ariaLabel: "Time" });
  const clock = add(bar, "output");
  time.oninput = () => { start(false); at = +time.value; draw(); };
  const choice = (words, values, name, chosen, choose) => {
    const row = add(home, "div", { className: "bar" });
    add(row, "span", { textContent: words });
    const buttons = values.map(value => add(row, "button", { textContent: name(value), onclick: () => {
      choose(value);
      buttons.forEach((button, k) => button.classList.toggle("chosen", values[k] === value));
      draw();
    } }));
    buttons[values.indexOf(chosen)].classList.add("chosen");
  };
  choice("Observer", observers, name => name, observer, value => { observer = value; });
  choice("Broken camera", broken, i => (i < 0 ? "none" : `f${i + 1}`), camera, value => { camera = value; });

  const start = on => { playing = on; before = null; play.textContent = on ? "Pause" : "Play"; if (on) requestAnimationFrame(step); };
  const step = now => {
    if (!playing) return;
    if (before !== null) at += (2 * (now - before) / 1000) * data.rate; // twice as fast as it was
    before = now;
    if (at > data.frames - 1) at = 0;
    draw();
    requestAnimationFrame(step);
  };

  function draw() {
    const k = Math.floor(at), parts = variants[`${observer}/${camera}`], pen = canvas.getContext("2d");
    const width = home.clientWidth, above = canvas.getBoundingClientRect().top + scrollY; // controls stay on the first screen
    const height = Math.max(280, Math.min(width, 460, innerHeight - above - 96)), scale = height / data.side, dots = devicePixelRatio || 1;
    canvas.width = width * dots;
    canvas.height = height * dots;
    canvas.style.height = `${height}px`;
    const x = u => width / 2 + (u - data.low[0] - data.side / 2) * scale, y = v => height - (v - data.low[1]) * scale;
    const path = points => { pen.beginPath(); points.forEach(([u, v]) => pen.lineTo(x(u), y(v))); pen.closePath(); };
    pen.scale(dots, dots);
    pen.fillStyle = "#8DAA74";
    pen.fillRect(0, 0, width, height);
    pen.fillStyle = "#54585D";
    for (const corners of data.roads) { path(corners); pen.fill(); }
    const truly = i => [0, 1, 2].map(n => truth[(k * count + i) * 3 + n] * data.step);
    const guess = i => [0, 1, 2, 3, 4, 5].map(n => parts.estimate[(k * count + i) * 6 + n] * data.step);
    const car = (i, [u, v, heading], solid) => {
      const [long, wide] = data.size[i], [cu, cv] = data.center[i], c = Math.cos(heading), s = Math.sin(heading);
      const corner = (a, b) => { const p = cu + a * long, q = cv + b * wide; return [u + c * p - s * q, v + s * p + c * q]; };
      path([corner(-.5, -.5), corner(.4, -.5), corner(.5, -.3), corner(.5, .3), corner(.4, .5), corner(-.5, .5)]);
      pen.globalAlpha = solid ? 1 : .45;
      pen.fillStyle = data.colours[i];
      pen.fill();
      if (!solid) { pen.globalAlpha = 1; pen.strokeStyle = data.colours[i]; pen.lineWidth = 1.5; pen.stroke(); return; }
      path([corner(.02, -.4), corner(.2, -.36), corner(.2, .36), corner(.02, .4)]);
      pen.fillStyle = "#1B2026";
      pen.fill();
      pen.font = "600 14px system-ui, sans-serif";
      pen.fillStyle = "#fff";
      pen.textAlign = "center";
      const words = `f${i + 1}${i === camera ? ", no camera" : ""}`, half = pen.measureText(words).width / 2 + 4;
      const place = [words, Math.min(Math.max(x(u), half), width - half), Math.max(y(v) - 16, 14)];
      pen.lineWidth = 3;
      pen.strokeStyle = "#1B2026";
      pen.strokeText(...place);
      pen.fillText(...place);
    };
    pen.lineWidth = 1;
    const targets = data.landmarks.length;
    for (let i = 0; i < count; i++) for (let j = 0; j < targets + count; j++) {
      if (!(parts.sight[k * count + i] >> j & 1)) continue;
      const from = truly(i), to = j < targets ? data.landmarks[j] : truly(j - targets);
      path([from, to]);
      pen.globalAlpha = .5;
      pen.strokeStyle = data.colours[i];
      pen.stroke();
      pen.globalAlpha = 1;
    }
    pen.fillStyle = "#00264D";
    for (const [u, v] of data.landmarks) { pen.beginPath(); pen.arc(x(u), y(v), 5, 0, 7); pen.fill(); }
    let lost = 0;
    for (let i = 0; i < count; i++) {
      const from = truly(i), to = guess(i), [u, v, , long, short, along] = to;
      lost += parts.lost[k * count + i] > 0;
      if (long > 0 && long < data.side / 3) {
        pen.beginPath();
        pen.ellipse(x(u), y(v), long * scale, short * scale, -along, 0, 7);
        pen.globalAlpha = .25;
        pen.fillStyle = data.colours[i];
        pen.fill();
        pen.globalAlpha = 1;
      }
      path([from, to]);
      pen.strokeStyle = data.colours[i];
      pen.lineWidth = 4;
      pen.stroke();
      car(i, to, false);
    }
    for (let i = 0; i < count; i++) car(i, truly(i), true);
    verdict.textContent = `${observer}: ${lost ? `${lost} of ${count} lost` : "found"}`;
    verdict.classList.toggle("lost", lost > 0);
    time.value = k;
    clock.textContent = `${(k / data.rate).toFixed(1)} s`;
  }
  addEventListener("resize", draw);
  start(!matchMedia("(prefers-reduced-motion: reduce)").matches);
  draw();
})();
