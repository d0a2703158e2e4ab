"use strict";
// Figures of the report. Without this script, and in print, the page shows static ones instead.
(() => {
  const source = document.getElementById("figure-data");
  if (!source) return;
  const data = JSON.parse(source.textContent);
  const root = document.documentElement;
  const colour = (name) => () => getComputedStyle(root).getPropertyValue(`--${name}`).trim();

  function bytes(text) {
    return Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0)).buffer;
  }

  // uPlot shows null as a gap.
  function numbers(text) {
    return Array.from(new Float32Array(bytes(text)), (x) => (Number.isFinite(x) ? x : null));
  }

  // Empty without a value: the legend shows values only under the cursor.
  function digits(value) {
    if (value === null || value === undefined) return "";
    return String(Number(value.toPrecision(4))).replace("-", "−");
  }

  function axis(label, size) {
    return {
      label,
      labelSize: 16,
      size,
      gap: 4,
      stroke: colour("quiet"),
      font: "12px system-ui, sans-serif",
      labelFont: "12px system-ui, sans-serif",
      grid: { stroke: colour("grid"), width: 1 },
      ticks: { show: false },
      values: (_, ticks) => ticks.map((tick) => (tick === null ? "" : digits(tick))),
    };
  }

  function line(label, name, width) {
    return {
      label,
      stroke: colour(name),
      width,
      points: { show: false },
      value: (_, value) => digits(value),
    };
  }

  function decades(min, max) {
    const [first, last] = [Math.ceil(Math.log10(min)), Math.floor(Math.log10(max))];
    return Array.from({ length: last - first + 1 }, (_, i) => Number(`1e${first + i}`));
  }

  const charts = [];

  function chart(holder, height, options, values) {
    const width = () => Math.max(holder.clientWidth, 200);
    const plot = new uPlot(
      {
        ...options,
        width: width(),
        height,
        // Half of a label at the end of the horizontal axis is beyond the plot.
        padding: [8, 24, 0, 0],
        cursor: { drag: { x: true, y: true, uni: 30 }, points: { size: 6 }, ...options.cursor },
      },
      values,
      holder,
    );
    new ResizeObserver(() => {
      if (plot.width !== width() && holder.clientWidth) plot.setSize({ width: width(), height });
    }).observe(holder);
    pinch(plot);
    charts.push(plot);
    return plot;
  }

  // Two fingers zoom along x; one finger scrolls the page.
  function pinch(plot) {
    const over = plot.over;
    let start = null;
    const place = (event) => {
      const box = over.getBoundingClientRect();
      return Array.from(event.touches, (touch) => plot.posToVal(touch.clientX - box.left, "x"));
    };
    over.style.touchAction = "pan-y";
    over.addEventListener("touchstart", (event) => {
      start = event.touches.length === 2 ? place(event) : null;
    });
    over.addEventListener("touchmove", (event) => {
      if (!start || event.touches.length !== 2) return;
      event.preventDefault();
      const [now, scale] = [place(event), plot.scales.x];
      const factor = (start[1] - start[0]) / (now[1] - now[0] || 1);
      const min = start[0] - (now[0] - scale.min) * factor;
      const max = min + (scale.max - scale.min) * factor;
      if (Number.isFinite(min) && max > min) plot.setScale("x", { min, max });
    });
  }

  function showForces() {
    const places = data.coordinates;
    const select = document.getElementById("coordinate");
    const holders = ["forces-plot", "errors-plot", "speed-plot", "spectrum-plot"].map((id) =>
      document.getElementById(id),
    );
    const time = numbers(data.time);
    const frequency = numbers(data.frequency);
    let shown = [];

    function shareTime(one, other) {
      one.hooks.setScale = [
        (plot, key) => {
          if (key !== "x" || !other.ready) return;
          const { min, max } = plot.scales.x;
          if (other.plot.scales.x.min !== min || other.plot.scales.x.max !== max)
            other.plot.setScale("x", { min, max });
        },
      ];
    }

    function draw(place) {
      for (const old of shown) {
        charts.splice(charts.indexOf(old), 1);
        old.destroy();
      }
      const { unit, name } = place;
      const kind = unit === "Nm" ? "torque" : "force";
      const [measured, before, after] = [place.measured, place.before, place.after].map(numbers);
      const minus = (one) => 
        one.map((value, i) => (value === null || measured[i] === null ? null : measured[i] - value));
      const sync = { key: "time" };
      const upper = { ready: false, hooks: {} };
      const lower = { ready: false, hooks: {} };
      shareTime(upper, lower);
      shareTime(lower, upper);
      upper.plot = chart(
        holders[0],
        260,
        {
          hooks: upper.hooks,
          cursor: { sync },
          scales: {
            x: { time: false },
            y: { range: (_, min, max) => within(min, max, place.range) },
          },
          axes: [axis("", 24), axis(`${kind} [${unit}]`, 52)],
          series: [
            { label: "time [s]", value: (_, value) => digits(value) },
            line("measured", "measured", 3),
            line("original model", "before", 1.2),
            line("identified model", "after", 1.5),
          ],
        },
        [time, measured, before, after],
      );
      lower.plot = chart(
        holders[1],
        180,
        {
          hooks: lower.hooks,
          cursor: { sync },
          scales: {
            x: { time: false },
            y: { range: (_, min, max) => robust(min, max, place.limit) },
          },
          axes: [axis("time [s]", 28), axis(`error [${unit}]`, 52)],
          series: [
            { label: "time [s]", value: (_, value) => digits(value) },
            line("original model", "before", 2.7),
            line("identified model", "after", 1.2),
          ],
        },
        [time, minus(before), minus(after)],
      );
      upper.ready = lower.ready = true;
      shown = [upper.plot, lower.plot];
      document.getElementById("speed-figure").hidden = !place.speed;
      if (place.speed) shown.push(drawSpeed(place, unit));
      if (frequency.length) shown.push(drawSpectrum(place, unit));
      for (const box of document.querySelectorAll(".coordinate-name")) box.textContent = name;
    }

    // An original model that is far off does not set the axis.
    function within(min, max, [low, high]) {
      if (min === null) return [-1, 1];
      if (high <= low) return [min, max];
      const pad = 0.05 * (max - min);
      return [Math.max(min - pad, low), Math.min(max + pad, high)];
    }

    // Unless the reader zooms, single outliers do not set the axis.
    function robust(min, max, limit) {
      if (min === null) return [-1, 1];
      return Math.max(-min, max) > limit && limit > 0
        ? [-limit, limit]
        : [Math.max(min * 1.05, -limit) || -1, Math.min(max * 1.05, limit) || 1];
    }

    function drawSpeed(place, unit) {
      const speed = numbers(place.speed);
      const [before, after] = [place.speedBefore, place.speedAfter].map(numbers);
      const [x1, y1, x2, y2] = place.medians.map(numbers);
      const rows = speed
        .map((value, i) => [value, before[i], after[i], null, null])
        .concat(x1.map((value, i) => [value, null, null, y1[i], null]))
        .concat(x2.map((value, i) => [value, null, null, null, y2[i]]))
        .filter((row) => row[0] !== null)
        .sort((one, other) => one[0] - other[0]);
      const columns = [0, 1, 2, 3, 4].map((i) => rows.map((row) => row[i]));
      const dots = (label, name) => ({
        ...line(label, name, 0),
        paths: () => null,
        points: { show: true, size: 4, width: 0, fill: colour(`${name}-faint`) },
      });
      const median = (label, name) => ({ ...line(label, name, 2.5), spanGaps: true });
      const limit = place.limit;
      return chart(
        holders[2],
        230,
        {
          legend: { show: false },
          scales: {
            x: { time: false },
            y: { range: (_, min, max) => robust(min, max, limit) },
          },
          axes: [axis(`speed [${unit === "Nm" ? "rad/s" : "m/s"}]`, 28), axis(`error [${unit}]`, 52)],
          series: [
            { label: "speed", value: (_, value) => digits(value) },
            dots("original model", "before"),
            dots("identified model", "after"),
            median("median", "before"),
            median("median", "after"),
          ],
        },
        columns,
      );
    }

    function drawSpectrum(place, unit) {
      const positive = (text) => numbers(text).map((value) => (value > 0 ? value : null));
      const [measured, before, after] = place.spectra.map(positive);
      return chart(
        holders[3],
        230,
        {
          scales: { x: { time: false }, y: { distr: 3 } },
          axes: [
            axis("frequency [Hz]", 28),
            {
              ...axis(`density [${unit}/√Hz]`, 58),
              splits: (_, __, min, max) => decades(min, max),
            },
          ],
          series: [
            { label: "frequency [Hz]", value: (_, value) => digits(value) },
            line("measured", "measured", 2.5),
            line("original model", "before", 1.2),
            line("identified model", "after", 1.5),
          ],
        },
        [frequency, measured, before, after],
      );
    }

    const groups = { joints: [], base: [] };
    for (const place of places) groups[place.name.startsWith("base/") ? "base" : "joints"].push(place);
    for (const [title, members] of Object.entries(groups)) {
      if (!members.length) continue;
      const group = document.createElement("optgroup");
      group.label = title === "base" ? "Base" : "Joints";
      for (const place of members) {
        group.append(new Option(place.name.replace("base/", "base "), place.index));
      }
      select.append(group);
    }
    const byIndex = new Map(places.map((place) => [String(place.index), place]));
    const choose = (index) => {
      select.value = index;
      draw(byIndex.get(index));
    };
    select.addEventListener("change", () => choose(select.value));
    for (const button of document.querySelectorAll("[data-step]")) {
      button.addEventListener("click", () => {
        const options = Array.from(select.options, (option) => option.value);
        const next = options.indexOf(select.value) + Number(button.dataset.step);
        choose(options[(next + options.length) % options.length]);
      });
    }
    for (const link of document.querySelectorAll("[data-coordinate]")) {
      const place = places.find((one) => one.name === link.dataset.coordinate);
      if (place) link.addEventListener("click", () => choose(String(place.index)));
    }
    document.getElementById("reset-zoom").addEventListener("click", () => choose(select.value));
    choose(String(data.first));
  }

  function showCorrelation() {
    const { names, values } = data.correlation;
    const matrix = new Int8Array(bytes(values));
    const image = document.getElementById("correlation-image");
    const output = document.getElementById("correlation-value");
    if (!image) return;
    const initial = output.textContent;
    image.addEventListener("pointermove", (event) => {
      const box = image.getBoundingClientRect();
      const index = (at, size) =>
        Math.min(names.length - 1, Math.max(0, Math.floor((at / size) * names.length)));
      const row = index(event.clientY - box.top, box.height);
      const column = index(event.clientX - box.left, box.width);
      const value = matrix[row * names.length + column] / 100;
      output.textContent = `${names[row]} and ${names[column]}: ${value.toFixed(2)}`.replace("-", "−");
    });
    image.addEventListener("pointerleave", () => (output.textContent = initial));
  }

  root.classList.add("scripted");
  if (data.coordinates) showForces();
  if (data.correlation) showCorrelation();
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => {
    for (const plot of charts) plot.redraw(false);
  });
})();
