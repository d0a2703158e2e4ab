// Keeps the page of a live identification up to date from server-sent events.
(function () {
  "use strict";

  const MOST_POINTS = 600; // of a curve; older ones are thinned out
  const WIDTH = 200, HEIGHT = 60; // of a curve's drawing
  const SVG = "http://www.w3.org/2000/svg";
  const token = new URLSearchParams(location.search).get("token");
  const view = document.querySelector(".robot-view").robotView;
  const charts = new Map();

  const byId = (id) => document.getElementById(id);

  function list(id, lines) {
    byId(id).replaceChildren(...lines.map((line) => {
      const item = document.createElement("li");
      item.textContent = line;
      return item;
    }));
  }

  class Chart {
    constructor(name, index) {
      this.points = []; // time, mass, standard deviation
      this.figure = document.createElement("figure");
      this.figure.className = "mass";
      this.figure.dataset.link = name;
      const caption = document.createElement("figcaption");
      const label = document.createElement("span");
      label.textContent = label.title = name;
      this.number = document.createElement("b");
      caption.append(label, this.number);
      const drawing = document.createElementNS(SVG, "svg");
      drawing.setAttribute("viewBox", `0 0 ${WIDTH} ${HEIGHT}`);
      drawing.setAttribute("preserveAspectRatio", "none");
      drawing.setAttribute("aria-hidden", "true");
      const part = (kind) => {
        const path = document.createElementNS(SVG, "path");
        path.setAttribute("class", kind);
        drawing.append(path);
        return path;
      };
      [this.band, this.before, this.line] = ["band", "before", "line"].map(part);
      this.figure.append(caption, drawing);
      this.figure.addEventListener("click", () => view.choose && view.choose(index));
      byId("masses").append(this.figure);
    }

    add(time, mass, std, text) {
      const last = this.points[this.points.length - 1];
      if (last && time <= last[0]) {
        this.points = this.points.filter((point) => point[0] < time); // a clock that jumped back
      }
      this.points.push([time, mass, std]);
      if (this.points.length > MOST_POINTS) {
        this.points = this.points.filter((_, index) => index % 2 === 0);
      }
      this.number.textContent = text;
    }

    clear() {
      this.points = [];
      this.number.textContent = "";
    }

    draw(before) {
      if (!this.points.length) {
        [this.band, this.line, this.before].forEach((path) => path.removeAttribute("d"));
        return;
      }
      // The newest bands set the scale, so that the first estimates do not flatten the curve.
      const recent = this.points.slice(-Math.max(10, this.points.length / 2));
      const marks = recent.flatMap(([, mass, std]) => [mass - 2 * std, mass + 2 * std]);
      let low = Math.min(...marks, before), high = Math.max(...marks, before);
      const room = 0.08 * (high - low) || 0.01;
      low -= room;
      high += room;
      const first = this.points[0][0];
      const span = this.points[this.points.length - 1][0] - first || 1;
      const x = (time) => (WIDTH * (time - first) / span).toFixed(1);
      const y = (mass) => (HEIGHT * (high - mass) / (high - low)).toFixed(1);
      const along = (points, value) => points.map((p) => `${x(p[0])} ${y(value(p))}`).join("L");
      this.line.setAttribute("d", "M" + along(this.points, (p) => p[1]));
      this.band.setAttribute("d", "M" + along(this.points, (p) => p[1] + 2 * p[2]) + "L"
        + along([...this.points].reverse(), (p) => p[1] - 2 * p[2]) + "z");
      this.before.setAttribute("d", `M0 ${y(before)}H${WIDTH}`);
    }
  }

  function add(estimate) {
    estimate.links.forEach((link, index) => {
      if (!charts.has(link.name)) {
        charts.set(link.name, new Chart(link.name, index));
      }
      const [mass, std] = link.mass;
      charts.get(link.name).add(estimate.time, mass, std, link.text);
    });
  }

  function draw(estimate) {
    estimate.links.forEach((link) => {
      const chart = charts.get(link.name);
      chart.draw(link.before_mass);
      chart.figure.classList.toggle("changed", link.changed);
    });
  }

  const handlers = {
    history(estimates) {
      charts.forEach((chart) => chart.clear());
      estimates.forEach(add);
      if (estimates.length) {
        draw(estimates[estimates.length - 1]);
      }
    },
    estimate(estimate) {
      add(estimate);
      draw(estimate);
    },
    scene(scene) {
      view.update(scene);
    },
    status(status) {
      byId("state").textContent = status.state;
      list("alarms", status.alarms);
      byId("followed").textContent = status.followed;
      list("streams", status.streams);
    },
    reset() {
      charts.forEach((chart) => {
        chart.clear();
        chart.draw(0);
      });
    },
  };

  const events = new EventSource(`events?token=${encodeURIComponent(token)}`);
  for (const [name, handle] of Object.entries(handlers)) {
    events.addEventListener(name, (event) => handle(JSON.parse(event.data)));
  }
  events.addEventListener("error", () => {
    byId("state").textContent = "disconnected";
  });

  for (const button of document.querySelectorAll("[data-action]")) {
    button.addEventListener("click", async () => {
      const answer = byId("answer");
      if (button.dataset.action === "reset" && !confirm("Discard all data so far?")) {
        return;
      }
      button.disabled = true;
      answer.textContent = "…";
      try {
        const response = await fetch(button.dataset.action, {
          method: "POST", headers: { "X-Symbid-Token": token },
        });
        const result = await response.json();
        answer.textContent = result.message;
        answer.classList.toggle("bad", !result.success);
      } catch (error) {
        answer.textContent = "no answer: the identifier's page has ended";
      }
      button.disabled = false;
    });
  }

  document.querySelector(".robot-view").addEventListener("choose", (event) => {
    charts.forEach((chart, name) => {
      chart.figure.classList.toggle("chosen", name === event.detail);
    });
  });
})();
