// Turnable view of a robot scene (robot_scene.py), drawn by three.js.
// A page's element .robot-view holds the scene as JSON; element.robotView then has the view.
(function () {
  "use strict";

  const EDGES = cubeEdges();
  const UNIT_SPHERE = new THREE.SphereGeometry(1, 24, 16);
  const UNIT_CUBE = new THREE.Box3(
    new THREE.Vector3(-0.5, -0.5, -0.5), new THREE.Vector3(0.5, 0.5, 0.5));
  const FADED = 0.12; // opacity of links that are not chosen
  const FIELD_OF_VIEW = 30; // degrees
  // Visible part of an inertia box outside the links, as share of the robot's size. Boxes larger
  // than the robot, which impossible inertias have, do not shrink it.
  const [WHOLE_BOX, BOX_MARGIN] = [2.0, 0.25];
  const TURN = Math.PI / 24; // of an arrow key

  // Corners of a unit cube's twelve edges.
  function cubeEdges() {
    const points = [];
    for (const axis of [0, 1, 2]) {
      for (const u of [-0.5, 0.5]) {
        for (const v of [-0.5, 0.5]) {
          for (const along of [-0.5, 0.5]) {
            const corner = [u, v];
            corner.splice(axis, 0, along);
            points.push(...corner);
          }
        }
      }
    }
    return points;
  }

  function decode(text, type) {
    const bytes = Uint8Array.from(atob(text), (letter) => letter.charCodeAt(0));
    return new type(bytes.buffer);
  }

  function geometryOf(mesh) {
    const integers = decode(mesh.vertices, Int16Array);
    const positions = new Float32Array(integers.length);
    for (let i = 0; i < integers.length; i++) {
      positions[i] = mesh.centre[i % 3] + mesh.scale * integers[i];
    }
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(positions, 3));
    geometry.setIndex(new THREE.BufferAttribute(
      decode(mesh.faces, mesh.wide ? Uint32Array : Uint16Array), 1));
    return THREE.toCreasedNormals(geometry, 0.7);
  }

  function overlay(material) {
    // Boxes and centres of mass are inside the links, and drawn over them.
    return Object.assign(material, { depthTest: false, depthWrite: false, transparent: true });
  }

  // The usual mark of a centre of mass: a disc with two dark quarters.
  function massMark(colour) {
    const canvas = document.createElement("canvas");
    canvas.width = canvas.height = 64;
    const pen = canvas.getContext("2d");
    const sector = (from, to, fill) => {
      pen.fillStyle = fill;
      pen.beginPath();
      pen.moveTo(32, 32);
      pen.arc(32, 32, 28, from * Math.PI, to * Math.PI);
      pen.fill();
    };
    sector(0, 2, "#fff");
    sector(0.5, 1, colour);
    sector(1.5, 2, colour);
    pen.strokeStyle = colour;
    pen.lineWidth = 5;
    pen.beginPath();
    pen.arc(32, 32, 28, 0, 2 * Math.PI);
    pen.stroke();
    const texture = new THREE.CanvasTexture(canvas);
    texture.colorSpace = THREE.SRGBColorSpace;
    return texture;
  }

  class RobotView {
    constructor(root, scene) {
      this.root = root;
      this.names = scene.links.map((link) => link.name);
      this.chosen = -1;
      this.canvas = root.querySelector("canvas");
      const context = this.canvas.getContext("webgl2", { antialias: true, alpha: true });
      if (!context) {
        return; // the still picture stays
      }
      this.renderer = new THREE.WebGLRenderer({ canvas: this.canvas, context, alpha: true });
      root.classList.add("turnable");
      this.materials = {
        before: overlay(new THREE.LineMaterial({ linewidth: 1.8, dashed: true })),
        after: overlay(new THREE.LineMaterial({ linewidth: 2 })),
        comBefore: overlay(new THREE.MeshBasicMaterial()),
        comAfter: overlay(new THREE.MeshBasicMaterial()),
        rim: overlay(new THREE.MeshBasicMaterial()),
        uncertainty: overlay(new THREE.MeshBasicMaterial({ opacity: 0.45 })),
      };
      this.scene = new THREE.Scene();
      this.scene.add(new THREE.HemisphereLight(0xffffff, 0x8888aa, 2.2));
      this.camera = new THREE.PerspectiveCamera(FIELD_OF_VIEW, 1, 0.01, 100);
      this.camera.up.fromArray(scene.up);
      const lamp = new THREE.DirectionalLight(0xffffff, 1.6);
      lamp.position.set(-1, 1.2, 1);
      this.camera.add(lamp);
      this.scene.add(this.camera);
      this.edges = new THREE.LineSegmentsGeometry().setPositions(EDGES);
      this.links = scene.links.map(() => this.addLink());
      for (const mesh of scene.meshes) {
        const material = new THREE.MeshLambertMaterial({ side: THREE.DoubleSide });
        const body = new THREE.Mesh(geometryOf(mesh), material);
        const link = this.links[mesh.link];
        body.userData.link = mesh.link;
        link.body = body;
        link.group.add(body);
      }
      this.controls = new THREE.OrbitControls(this.camera, this.canvas);
      this.controls.enableZoom = false;
      // Vertical strokes scroll the page on phones; horizontal ones turn the robot.
      this.canvas.style.touchAction = "pan-y";
      this.controls.addEventListener("change", () => this.draw());
      this.direction = new THREE.Vector3().fromArray(scene.camera);
      this.update(scene);
      this.addTotals(scene);
      this.connect(scene);
      this.theme();
      this.resize();
      this.reset();
    }

    addLink() {
      const group = new THREE.Group();
      const link = { group, body: null };
      const add = (key, object, order) => {
        object.renderOrder = order;
        object.visible = false;
        link[key] = object;
        group.add(object);
      };
      const dashed = new THREE.LineSegmentsGeometry().setPositions(EDGES);
      add("before", new THREE.LineSegments2(dashed, this.materials.before), 2);
      add("after", new THREE.LineSegments2(this.edges, this.materials.after), 3);
      add("uncertainty", new THREE.Mesh(UNIT_SPHERE, this.materials.uncertainty), 4);
      add("comBefore", new THREE.Mesh(UNIT_SPHERE, this.materials.comBefore), 5);
      add("rim", new THREE.Mesh(UNIT_SPHERE, this.materials.rim), 6);
      add("comAfter", new THREE.Mesh(UNIT_SPHERE, this.materials.comAfter), 7);
      this.scene.add(group);
      return link;
    }

    // Takes new poses, inertias and numbers of the links. Meshes stay.
    update(scene) {
      this.data = scene.links;
      this.totals = scene.com;
      if (!this.renderer) {
        return;
      }
      scene.links.forEach((data, index) => {
        const link = this.links[index];
        link.group.position.fromArray(data.position);
        link.group.quaternion.fromArray(data.quaternion);
        if (link.body) {
          link.body.material.color.set(data.colour);
        }
        for (const key of ["before", "after"]) {
          const box = data[key];
          if (box) {
            link[key].position.fromArray(box.com);
            link[key].quaternion.fromArray(box.quaternion);
            link[key].scale.fromArray(box.size).clampScalar(1e-4, 1e3);
          }
        }
        if (data.before) {
          this.dash(link.before);
        }
        if (data.com.before) {
          link.comBefore.position.fromArray(data.com.before);
        }
        if (data.com.after) {
          link.comAfter.position.fromArray(data.com.after);
          link.rim.position.copy(link.comAfter.position);
        }
        if (data.uncertainty) {
          link.uncertainty.position.fromArray(data.com.after);
          link.uncertainty.quaternion.fromArray(data.uncertainty.quaternion);
          link.uncertainty.scale.fromArray(data.uncertainty.std)
            .multiplyScalar(scene.deviations).clampScalar(1e-5, 1e3);
        }
      });
      for (const key of ["before", "after"]) {
        if (this.total) {
          this.total[key].position.fromArray(scene.com[key]);
        }
      }
      this.show();
    }

    // Gives the dashes of all edges one length, although the box is a cube with a scale.
    dash(box) {
      const size = box.scale.toArray();
      if (String(size) === String(box.userData.size)) {
        return;
      }
      box.userData.size = size;
      box.geometry.setPositions(EDGES.map((place, i) => place * size[i % 3]));
      box.computeLineDistances();
      box.geometry.setPositions(EDGES);
    }

    // Measures the robot, and adds the marks of its centre of mass.
    addTotals(scene) {
      const box = new THREE.Box3();
      for (const link of this.links) {
        link.group.updateMatrixWorld(true);
        if (link.body) {
          box.expandByObject(link.body);
        }
      }
      if (box.isEmpty()) {
        box.setFromCenterAndSize(new THREE.Vector3(), new THREE.Vector3(1, 1, 1));
      }
      const size = box.getSize(new THREE.Vector3());
      this.size = size.length();
      this.materials.before.dashSize = 0.02 * this.size;
      this.materials.before.gapSize = 0.013 * this.size;
      const longest = Math.max(size.x, size.y, size.z);
      this.framed = this.framedPoints(box.clone().expandByScalar(BOX_MARGIN * longest), longest);
      this.centre = box.setFromPoints(this.framed).getCenter(new THREE.Vector3());
      for (const link of this.links) {
        link.comBefore.scale.setScalar(0.008 * this.size);
        link.rim.scale.setScalar(0.008 * this.size);
        link.comAfter.scale.setScalar(0.006 * this.size);
      }
      this.total = {};
      for (const key of ["before", "after"]) {
        const material = new THREE.SpriteMaterial({ sizeAttenuation: false });
        const mark = new THREE.Sprite(overlay(material));
        mark.scale.setScalar(0.028);
        mark.renderOrder = key === "before" ? 8 : 9;
        mark.position.fromArray(scene.com[key]);
        this.total[key] = mark;
        this.scene.add(mark);
      }
    }

    connect(scene) {
      const select = this.root.querySelector("select");
      scene.links.forEach((link, index) => select.add(new Option(link.name, index)));
      select.addEventListener("change", () => this.choose(Number(select.value)));
      this.boxes = {};
      for (const input of this.root.querySelectorAll("input[type=checkbox]")) {
        this.boxes[input.name] = input;
        input.addEventListener("change", () => this.show());
      }
      this.root.querySelector("button").addEventListener("click", () => this.reset());
      let down = null;
      this.canvas.addEventListener("pointerdown", (event) => {
        down = [event.clientX, event.clientY];
        this.controls.enableZoom = true; // before that, the wheel scrolls the page
      });
      this.canvas.addEventListener("pointerleave", () => { this.controls.enableZoom = false; });
      this.canvas.addEventListener("pointerup", (event) => {
        if (down && Math.hypot(event.clientX - down[0], event.clientY - down[1]) < 5) {
          this.pick(event);
        }
        down = null;
      });
      this.canvas.addEventListener("keydown", (event) => this.turn(event));
      new ResizeObserver(() => this.resize()).observe(this.canvas.parentElement);
      matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.theme());
      this.show();
    }

    turn(event) {
      const sign = { ArrowLeft: -1, ArrowRight: 1, ArrowUp: 1, ArrowDown: -1 }[event.key];
      if (!sign) {
        return;
      }
      event.preventDefault();
      const arm = this.camera.position.clone().sub(this.controls.target);
      const sideways = event.key === "ArrowLeft" || event.key === "ArrowRight";
      const axis = sideways
        ? this.camera.up.clone()
        : arm.clone().cross(this.camera.up).normalize();
      arm.applyAxisAngle(axis, sign * TURN);
      this.camera.position.copy(this.controls.target).add(arm);
      this.controls.update();
      this.draw();
    }

    pick(event) {
      const bounds = this.canvas.getBoundingClientRect();
      const pointer = new THREE.Vector2(
        2 * (event.clientX - bounds.left) / bounds.width - 1,
        1 - 2 * (event.clientY - bounds.top) / bounds.height);
      const ray = new THREE.Raycaster();
      ray.setFromCamera(pointer, this.camera);
      const bodies = this.links.map((link) => link.body).filter((body) => body && body.visible);
      const hit = ray.intersectObjects(bodies, false)[0];
      this.choose(hit ? hit.object.userData.link : -1);
    }

    choose(index) {
      this.chosen = index;
      this.root.querySelector("select").value = String(index);
      this.show();
      this.root.dispatchEvent(new CustomEvent("choose", { detail: this.names[index] || "" }));
    }

    // Applies the choice of link and the check boxes.
    show() {
      if (!this.boxes) {
        return;
      }
      const on = (name) => this.boxes[name].checked;
      this.links.forEach((link, index) => {
        const data = this.data[index];
        const isShown = this.chosen < 0 || this.chosen === index;
        link.before.visible = Boolean(data.before) && isShown && on("before");
        link.after.visible = Boolean(data.after) && isShown && on("after");
        const coms = isShown && on("com");
        link.comBefore.visible = Boolean(data.com.before) && coms && on("before");
        link.comAfter.visible = link.rim.visible = Boolean(data.com.after) && coms;
        // Ellipsoids larger than the robot would hide everything.
        link.uncertainty.visible = Boolean(data.uncertainty) && coms
          && 2 * Math.max(...link.uncertainty.scale.toArray()) < this.size;
        if (link.body) {
          const material = link.body.material;
          link.body.visible = on("shapes");
          material.transparent = !isShown;
          material.opacity = isShown ? 1 : FADED;
          material.depthWrite = isShown;
          material.needsUpdate = true;
        }
      });
      this.total.before.visible = on("com") && on("before") && this.chosen < 0;
      this.total.after.visible = on("com") && this.chosen < 0;
      this.table();
      this.draw();
    }

    table() {
      const table = this.root.querySelector(".robot-numbers");
      const data = this.data[this.chosen];
      table.hidden = !data;
      if (!data) {
        return;
      }
      const known = data.determined === null ? "" : `, ${data.determined} of 10 parameters determined`;
      const faults = [["before", "the original model"], ["after", "the estimate"]]
        .filter(([key]) => data.com[key] && !data[key])
        .map(([, name]) => `; no rigid body has the inertia of ${name}, so it has no box`);
      table.caption.textContent = data.name + known + faults.join("");
      table.tBodies[0].replaceChildren(...data.numbers.map((cells) => {
        const row = document.createElement("tr");
        cells.forEach((text, index) => {
          const cell = document.createElement(index ? "td" : "th");
          cell.textContent = text;
          row.append(cell);
        });
        return row;
      }));
    }

    theme() {
      const colour = getComputedStyle(this.root);
      const read = (name) => colour.getPropertyValue(name).trim();
      this.materials.after.color.set(colour.color);
      this.materials.comAfter.color.set(colour.color);
      this.materials.before.color.set(read("--robot-before"));
      this.materials.comBefore.color.set(read("--robot-before"));
      this.materials.uncertainty.color.set(read("--robot-uncertainty"));
      this.materials.rim.color.set(read("--robot-ground"));
      for (const [key, mark] of [["before", read("--robot-before")], ["after", "#111"]]) {
        this.total[key].material.map?.dispose();
        this.total[key].material.map = massMark(mark);
        this.total[key].material.needsUpdate = true;
      }
      this.draw();
    }

    reset() {
      this.choose(-1);
      const distance = this.distance();
      this.controls.target.copy(this.centre);
      this.camera.near = distance / 100;
      this.camera.far = 10 * distance;
      this.camera.position.copy(this.centre).addScaledVector(this.direction, distance);
      this.camera.updateProjectionMatrix();
      this.controls.update();
      this.draw();
    }

    // Corners of the links' shapes and of the inertia boxes, those much larger than the robot within
    // limits.
    framedPoints(limits, robot) {
      const points = [limits.getCenter(new THREE.Vector3())];
      const add = ({ min, max }, object) => {
        const corners = [];
        for (let corner = 0; corner < 8; corner++) {
          const point = new THREE.Vector3(
            corner & 1 ? min.x : max.x, corner & 2 ? min.y : max.y, corner & 4 ? min.z : max.z);
          corners.push(point.applyMatrix4(object.matrixWorld));
        }
        const size = new THREE.Box3().setFromPoints(corners).getSize(new THREE.Vector3());
        const isWhole = Math.max(size.x, size.y, size.z) <= WHOLE_BOX * robot;
        for (const point of corners) {
          points.push(isWhole ? point : limits.clampPoint(point, point));
        }
      };
      this.links.forEach((link, index) => {
        if (link.body) {
          link.body.geometry.computeBoundingBox();
          add(link.body.geometry.boundingBox, link.body);
        }
        for (const key of ["before", "after"]) {
          if (this.data[index][key]) {
            add(UNIT_CUBE, link[key]);
          }
        }
      });
      return points;
    }

    // The distance from which all of these points are in view.
    distance() {
      const towards = this.direction;
      const right = this.camera.up.clone().cross(towards).normalize();
      const above = towards.clone().cross(right);
      const slope = 0.95 * Math.tan(FIELD_OF_VIEW * Math.PI / 360);
      let largest = 0.1 * this.size;
      for (const framed of this.framed) {
        const point = framed.clone().sub(this.centre);
        const wide = Math.abs(point.dot(right)) / this.camera.aspect;
        const high = Math.abs(point.dot(above));
        largest = Math.max(largest, Math.max(wide, high) / slope + point.dot(towards));
      }
      return largest;
    }

    resize() {
      const frame = this.canvas.parentElement;
      if (!frame.clientWidth || !frame.clientHeight) {
        return;
      }
      this.renderer.setPixelRatio(Math.min(window.devicePixelRatio, 2));
      this.renderer.setSize(frame.clientWidth, frame.clientHeight, false);
      this.camera.aspect = frame.clientWidth / frame.clientHeight;
      this.camera.updateProjectionMatrix();
      this.draw();
    }

    // Draws once, with the next frame of the screen.
    draw() {
      if (!this.renderer || this.pending) {
        return;
      }
      this.pending = requestAnimationFrame(() => {
        this.pending = 0;
        this.renderer.render(this.scene, this.camera);
      });
    }
  }

  for (const root of document.querySelectorAll(".robot-view")) {
    const scene = JSON.parse(root.querySelector("script[type='application/json']").textContent);
    root.robotView = new RobotView(root, scene);
  }
})();
