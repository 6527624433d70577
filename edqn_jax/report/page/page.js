"use strict";
/* The 3D view, the player and the curves of the page; the data stand in the element #data. */
(() => {
  const data = JSON.parse(document.getElementById("data").textContent);
  const byId = (id) => document.getElementById(id);
  const COLUMN = Object.fromEntries(data.columns.map((name, index) => [name, index]));
  const WIDTH = data.columns.length;
  const SUN = [-0.45, -0.6, 0.66];

  function make(tag, text = "", attributes = {}) {
    const element = document.createElement(tag);
    element.textContent = text;
    return Object.assign(element, attributes);
  }

  // ------------------------------------------------------------------ flights

  /** Decodes the rows of a flight once, and keeps them. */
  function rowsOf(flight) {
    if (!flight.table) {
      const bytes = Uint8Array.from(atob(flight.rows), (letter) => letter.charCodeAt(0));
      flight.table = new Float32Array(bytes.buffer);
      flight.count = flight.table.length / WIDTH;
      flight.end = flight.table[(flight.count - 1) * WIDTH];
    }
    return flight.table;
  }

  /** Returns the row before a time, and the share of the way to the next. */
  function place(flight, time) {
    const table = rowsOf(flight);
    let low = 0, high = flight.count - 1;
    while (low < high) {
      const middle = (low + high + 1) >> 1;
      if (table[middle * WIDTH] <= time) low = middle; else high = middle - 1;
    }
    const next = Math.min(low + 1, flight.count - 1);
    const span = table[next * WIDTH] - table[low * WIDTH];
    return [low, next, span > 0 ? Math.min(Math.max((time - table[low * WIDTH]) / span, 0), 1) : 0];
  }

  function valueAt(flight, time, name) {
    const [row, next, share] = place(flight, time), column = COLUMN[name];
    return flight.table[row * WIDTH + column] * (1 - share) + flight.table[next * WIDTH + column] * share;
  }

  function poseAt(flight, time) {
    const [row, next, share] = place(flight, time);
    const read = (at, name) => flight.table[at * WIDTH + COLUMN[name]];
    const point = (at) => new THREE.Vector3(read(at, "x"), read(at, "y"), read(at, "z"));
    const turn = (at) => new THREE.Quaternion(read(at, "qx"), read(at, "qy"), read(at, "qz"), read(at, "qw"));
    return [point(row).lerp(point(next), share), turn(row).slerp(turn(next), share)];
  }

  function pathOf(flight) {
    const table = rowsOf(flight), points = [...flight.start];
    for (let row = 0; row < flight.count; row++) points.push(...table.subarray(row * WIDTH + 1, row * WIDTH + 4));
    return points;
  }

  // ------------------------------------------------------------------ the 3D view

  class View {
    constructor(canvas) {
      this.renderer = new THREE.WebGLRenderer({ canvas, antialias: true, preserveDrawingBuffer: true });
      this.renderer.setPixelRatio(Math.min(window.devicePixelRatio || 1, 2));
      this.renderer.localClippingEnabled = true;
      this.scene = new THREE.Scene();
      this.scene.background = new THREE.Color("#e9eef3");
      this.scene.add(new THREE.HemisphereLight("#ffffff", "#b9b4a6", 2.2));
      const sun = new THREE.DirectionalLight("#ffffff", 1.6);
      sun.position.set(...SUN);
      this.scene.add(sun);
      this.camera = new THREE.PerspectiveCamera(45, 1, 0.1, 4000);
      this.camera.up.set(0, 0, 1);
      this.controls = new THREE.OrbitControls(this.camera, canvas);
      this.controls.maxPolarAngle = Math.PI * 0.495;
      this.mode = "orbit";
      this.world = -1;
      this.flights = [];
      this.balls = [];
    }

    /** Shows a world, the flights in it, one of them chosen. */
    show(number, flights, chosen) {
      const world = data.worlds[number];
      if (number !== this.world) {
        this.drop("solids");
        this.solids = new THREE.Group();
        this.closing = [];
        this.hiding = [];
        this.movers = [];
        this.solids.add(ground(world));
        for (const shape of world.shapes) {
          const solid = solidOf(shape);
          this.solids.add(solid);
          if (shape.closes) this.closing.push([solid, shape]);
          if (shape.moves) this.movers.push([solid, shape]);
          if (shape.hides) this.hiding.push(cutOff(solid));
        }
        this.scene.add(this.solids);
      }
      this.drop("moving");
      this.moving = new THREE.Group();
      this.flights = flights.map(({ flight, colour }) => this.addFlight(flight, colour, flight === chosen, flights.length > 30 ? 0.25 : 0.5));
      this.balls = (chosen.balls ?? []).map((shape) => [solidOf(shape), shape]);
      this.balls.forEach(([solid]) => this.moving.add(solid));
      this.addEnds(chosen, world);
      this.scene.add(this.moving);
      this.chosen = chosen;
      if (number !== this.world) {
        this.world = number;
        this.frame();
      }
    }

    drop(name) {
      if (!this[name]) return;
      this.scene.remove(this[name]);
      this[name].traverse((part) => { part.geometry?.dispose(); part.material?.dispose(); });
      this[name] = null;
    }

    addFlight(flight, colour, chosen, faint) {
      const line = new THREE.Line2(
        new THREE.LineGeometry().setPositions(pathOf(flight)),
        new THREE.LineMaterial({ color: colour, linewidth: chosen ? 4 : 1.6, transparent: !chosen, opacity: chosen ? 1 : faint }),
      );
      const drone = droneOf(colour, chosen ? flight : null);
      this.moving.add(line, drone);
      return { flight, line, drone, chosen };
    }

    addEnds(flight, world) {
      const goal = new THREE.Mesh(
        new THREE.SphereGeometry(flight.goal_radius, 24, 16),
        new THREE.MeshBasicMaterial({ color: data.outcomes.goal.colour, transparent: true, opacity: 0.35, depthWrite: false }),
      );
      goal.position.set(...flight.goal);
      const size = reach(world) / 90;
      const start = new THREE.Mesh(new THREE.SphereGeometry(size), new THREE.MeshBasicMaterial({ color: "#0072b2" }));
      start.position.set(...flight.start);
      this.moving.add(goal, start);
      for (const [point, colour] of [[flight.start, "#0072b2"], [flight.goal, data.outcomes.goal.colour]]) {
        const stem = new THREE.BufferGeometry().setFromPoints(
          [new THREE.Vector3(...point), new THREE.Vector3(point[0], point[1], world.lower[2])]);
        this.moving.add(new THREE.Line(stem, new THREE.LineBasicMaterial({ color: colour })));
      }
    }

    /** Puts the camera where it sees the whole volume. */
    frame() {
      const world = data.worlds[this.world];
      if (!world) return;
      const middle = world.lower.map((low, axis) => (low + world.upper[axis]) / 2);
      const wide = 0.98 + 0.72 / Math.min(this.camera.aspect, 1.3);
      const away = reach(world) * wide;
      this.controls.target.set(middle[0], middle[1] - 0.05 * reach(world), world.lower[2] + 0.25 * (world.upper[2] - world.lower[2]));
      this.camera.position.set(middle[0] + 0.36 * away, middle[1] - 0.68 * away, world.lower[2] + 0.62 * away);  // as in figures
      if (this.mode === "map") this.camera.position.set(middle[0], middle[1] - 0.001 * away, world.upper[2] + 0.95 * away);
      this.controls.update();
    }

    setMode(mode) {
      this.mode = mode;
      this.controls.enabled = mode === "orbit" || mode === "map";
      this.camera.up.set(0, 0, 1);
      this.camera.fov = 45;
      this.camera.updateProjectionMatrix();
      if (this.controls.enabled) this.frame();
    }

    draw(time) {
      const { clientWidth, clientHeight } = this.renderer.domElement, world = data.worlds[this.world];
      if (clientWidth !== this.width || clientHeight !== this.height) {
        const first = this.width === undefined;
        [this.width, this.height] = [clientWidth, clientHeight];
        this.renderer.setSize(clientWidth, clientHeight, false);
        this.camera.aspect = clientWidth / Math.max(clientHeight, 1);
        this.camera.updateProjectionMatrix();
        if (first) this.frame();
      }
      for (const { flight, line, drone, chosen } of this.flights) {
        const [position, turn] = poseAt(flight, (rowsOf(flight), Math.min(time, flight.end)));
        drone.position.copy(position);
        drone.quaternion.copy(turn);
        const riding = !this.controls.enabled, far = riding ? 160 : chosen ? 40 : 90;
        const least = chosen ? 1 : Math.min(1, reach(world) / 40);  // a hundred others would fill a small room
        const scale = Math.max(least, position.distanceTo(this.camera.position) / far);
        drone.children.forEach((part) => { if (part.name === "body") part.scale.setScalar(scale); });
        if (chosen) {
          const cut = position.z + 1;
          this.hiding.forEach((plane) => { plane.constant = !riding && this.camera.position.z > cut ? cut : 1e9; });
          this.sightOf(drone, turn, flight);
          drone.visible = this.mode !== "eye";
          line.visible = this.mode !== "eye";
          this.ride(position, turn, flight);
        }
      }
      for (const [solid, shape] of [...this.movers, ...this.balls]) {
        const at = placeOf(shape, world, Math.min(time, this.chosen.end));
        solid.visible = at !== null;
        if (at) solid.position.set(...at);
      }
      for (const [solid, shape] of this.closing) {
        const [axis, sign] = shape.closes, eye = this.camera.position.getComponent(axis);
        solid.visible = sign * (eye - shape.at[axis]) < 0;
      }
      this.renderer.render(this.scene, this.camera);
    }

    /** Turns the field of view with the heading alone where the camera hangs level. */
    sightOf(drone, turn, flight) {
      const sight = drone.getObjectByName("sight");
      if (!sight) return;
      sight.visible = this.mode !== "eye";
      sight.quaternion.identity();
      if (flight.level) sight.quaternion.copy(turn).invert().multiply(headingOf(turn));
    }

    ride(position, turn, flight) {
      if (this.mode !== "follow" && this.mode !== "eye") return;
      const heading = this.mode === "eye" && !flight.level ? turn : headingOf(turn);
      const ahead = new THREE.Vector3(1, 0, 0).applyQuaternion(heading);
      if (this.mode === "eye") {
        this.camera.position.copy(position);
        this.camera.up.set(0, 0, 1).applyQuaternion(heading);
        this.camera.lookAt(position.clone().add(ahead));
        const half = Math.tan((flight.fov_deg / 2) * Math.PI / 180) / Math.max(this.camera.aspect, flight.aspect);
        this.camera.fov = 2 * Math.atan(half) * 180 / Math.PI;
      } else {
        this.camera.position.copy(position).addScaledVector(ahead, -9).add(new THREE.Vector3(0, 0, 4));
        this.camera.lookAt(position.clone().addScaledVector(ahead, 4));
      }
      this.camera.updateProjectionMatrix();
    }
  }

  function headingOf(turn) {
    const size = Math.hypot(turn.w, turn.z) || 1;
    return new THREE.Quaternion(0, 0, turn.z / size, turn.w / size);
  }

  function reach(world) {
    return Math.max(...world.upper.map((high, axis) => high - world.lower[axis]));
  }

  function ground(world) {
    const [x0, y0, z0] = world.lower, [x1, y1] = world.upper, group = new THREE.Group();
    const floor = new THREE.Mesh(new THREE.PlaneGeometry(x1 - x0, y1 - y0), new THREE.MeshLambertMaterial({ color: "#dcd8cc" }));
    floor.position.set((x0 + x1) / 2, (y0 + y1) / 2, Math.min(z0, 0) - 0.02);
    const step = reach(world) > 60 ? 10 : 5, points = [];
    for (let x = Math.ceil(x0 / step) * step; x <= x1; x += step) points.push([x, y0], [x, y1]);
    for (let y = Math.ceil(y0 / step) * step; y <= y1; y += step) points.push([x0, y], [x1, y]);
    const lines = new THREE.BufferGeometry().setFromPoints(points.map(([x, y]) => new THREE.Vector3(x, y, floor.position.z + 0.02)));
    group.add(floor, new THREE.LineSegments(lines, new THREE.LineBasicMaterial({ color: "#c6c1b2" })));
    const box = new THREE.BoxGeometry(...world.upper.map((high, axis) => high - world.lower[axis]));
    const edges = new THREE.LineSegments(new THREE.EdgesGeometry(box), new THREE.LineBasicMaterial({ color: "#aab4be" }));
    edges.position.set(...world.lower.map((low, axis) => (low + world.upper[axis]) / 2));
    group.add(edges);
    return group;
  }

  /** Returns where a shape that moves is at a time, or null where it is not there: `sim/scene/motion.py` in other words. */
  function placeOf(shape, world, time) {
    const how = shape.moves;
    if (how.velocity) {
      const cos = Math.cos(how.rate * time) - 1, sin = Math.sin(how.rate * time);
      return shape.at.map((at, axis) => {
        let place = at + how.swing[0][axis] * cos + how.swing[1][axis] * sin;
        if (how.velocity[axis]) {
          const low = how.low[axis], span = how.high[axis] - low;
          const ahead = at - low + how.velocity[axis] * time;
          place += low + span - Math.abs(ahead - 2 * span * Math.floor(ahead / (2 * span)) - span) - at;
        }
        return place;
      });
    }
    const after = time - how.hit;
    if (after <= -how.early) return null;
    const place = how.aim.map((aim, axis) => aim - how.speed * after * how.from[axis]);
    place[2] -= how.gravity * after * (after + how.early) / 2;
    const out = shape.radius + how.outside;
    return place.every((x, axis) => x >= world.lower[axis] - out && x <= world.upper[axis] + out) ? place : null;
  }

  /** Returns a solid of flat faces, rings of corners in any orientation about a centre within. */
  function geometryOf(faces) {
    const corners = [];
    for (const ring of faces) {
      for (let i = 1; i + 1 < ring.length; i++) {
        const [a, b, c] = [ring[0], ring[i], ring[i + 1]].map((corner) => new THREE.Vector3(...corner));
        const outward = b.clone().sub(a).cross(c.clone().sub(a)).dot(a) > 0;
        for (const corner of outward ? [a, b, c] : [a, c, b]) corners.push(corner.x, corner.y, corner.z);
      }
    }
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(corners), 3));
    geometry.computeVertexNormals();
    return geometry;
  }

  const BOTH_SIDES = 2;  // three.js's own number

  /** Returns a surface of triangles. */
  function meshOf({ vertices, triangles }) {
    const geometry = new THREE.BufferGeometry();
    geometry.setAttribute("position", new THREE.BufferAttribute(new Float32Array(triangles.flat().flatMap((corner) => vertices[corner])), 3));
    geometry.computeVertexNormals();
    return geometry;
  }

  /** Lets a solid end at a height, and returns the plane that says which. */
  function cutOff(solid) {
    const plane = { normal: new THREE.Vector3(0, 0, -1), constant: 1e9 };
    solid.material.clippingPlanes = [plane];
    return plane;
  }

  function solidOf(shape) {
    let geometry;
    if (shape.kind === "box") geometry = new THREE.BoxGeometry(...shape.half.map((half) => 2 * half));
    else if (shape.kind === "sphere") geometry = new THREE.SphereGeometry(shape.radius, 32, 20);
    else if (shape.kind === "capsule") geometry = new THREE.CapsuleGeometry(shape.radius, 2 * shape.half, 10, 28);
    else if (shape.kind === "faces") geometry = geometryOf(shape.faces);
    else if (shape.kind === "mesh") geometry = meshOf(shape);
    else geometry = new THREE.CylinderGeometry(shape.radius, shape.radius, 2 * shape.half, 40);
    const solid = new THREE.Mesh(geometry, new THREE.MeshLambertMaterial({ color: shape.colour, side: shape.kind === "mesh" ? BOTH_SIDES : 0 }));
    if (shape.turn) {
      const m = shape.turn;
      solid.quaternion.setFromRotationMatrix(
        new THREE.Matrix4().set(m[0], m[1], m[2], 0, m[3], m[4], m[5], 0, m[6], m[7], m[8], 0, 0, 0, 0, 1));
    } else if (shape.axis) {
      solid.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), new THREE.Vector3(...shape.axis));
    }
    solid.position.set(...shape.at);
    return solid;
  }

  /** Makes a quadrotor, with the field of view of its camera where its flight is given. */
  function droneOf(colour, flight) {
    const drone = new THREE.Group(), body = new THREE.Group();
    body.name = "body";
    const dark = new THREE.MeshLambertMaterial({ color: "#333333" }), bright = new THREE.MeshLambertMaterial({ color: colour });
    body.add(new THREE.Mesh(new THREE.BoxGeometry(0.4, 0.22, 0.12), bright));
    for (const [x, y] of [[1, 1], [1, -1], [-1, 1], [-1, -1]]) {
      const arm = new THREE.Mesh(new THREE.BoxGeometry(0.42, 0.05, 0.04), dark);
      arm.position.set(0.15 * x, 0.15 * y, 0);
      arm.rotation.z = Math.atan2(y, x);
      const rotor = new THREE.Mesh(new THREE.CylinderGeometry(0.17, 0.17, 0.03, 20), bright);
      rotor.rotation.x = Math.PI / 2;
      rotor.position.set(0.28 * x, 0.28 * y, 0.05);
      body.add(arm, rotor);
    }
    drone.add(body);
    if (flight) {
      const far = 7, right = far * Math.tan((flight.fov_deg / 2) * Math.PI / 180), up = right / flight.aspect;
      const eye = [0, 0, 0], ends = [[far, right, up], [far, -right, up], [far, -right, -up], [far, right, -up]];
      const points = ends.flatMap((end, index) => [eye, end, end, ends[(index + 1) % 4]]);
      const geometry = new THREE.BufferGeometry().setFromPoints(points.map((point) => new THREE.Vector3(...point)));
      const sight = new THREE.LineSegments(geometry, new THREE.LineBasicMaterial({ color: colour, transparent: true, opacity: 0.55 }));
      sight.name = "sight";
      drone.add(sight);
    }
    return drone;
  }

  // ------------------------------------------------------------------ what the drone saw

  class Panels {
    constructor(place) { this.place = place; this.shown = []; }

    show(flight) {
      this.place.replaceChildren();
      this.shown = [];
      this.flight = flight;
      const pictures = flight.pictures;
      if (!pictures) {
        this.place.append(make("p", flight.no_pictures || ""));
        return;
      }
      for (const panel of pictures.panels) {
        const canvas = make("canvas", "", { width: pictures.width, height: pictures.height });
        const figure = make("figure");
        figure.append(make("figcaption", panel.name, { title: panel.name }), canvas);
        this.place.append(figure);
        const strip = new Image(), entry = { strip, context: canvas.getContext("2d"), frame: -1 };
        strip.src = "data:image/png;base64," + panel.png;
        this.shown.push(entry);
      }
    }

    draw(time) {
      const pictures = this.flight?.pictures;
      if (!pictures) return;
      const { width, height, frames } = pictures;
      const frame = Math.min(Math.max(Math.floor(time / this.flight.decision_s + 1e-4) - 1, 0), frames - 1);
      for (const entry of this.shown) {
        if (entry.frame === frame || !entry.strip.complete || !entry.strip.naturalWidth) continue;
        entry.context.drawImage(entry.strip, 0, frame * height, width, height, 0, 0, width, height);
        entry.frame = frame;
      }
    }
  }

  // ------------------------------------------------------------------ curves

  const AXIS = { stroke: "#6f6f6f", grid: { stroke: "#e8e6df", width: 1 }, ticks: { stroke: "#d9d7d0" }, font: "11px system-ui" };
  const short = (value) => Math.abs(value) >= 1e6 ? +(value / 1e6).toFixed(2) + "M" : Math.abs(value) >= 1e3 ? +(value / 1e3).toFixed(1) + "k" : String(+value.toFixed(2));
  const charts = [];

  /** Draws lines `{label, colour, x, y, dash}` over one axis; returns the chart. */
  function chart(place, title, lines, { height = 190, format = short, range, legend = true } = {}) {
    const box = make("div", "", { className: "chart" });
    box.append(make("h3", title));
    place.append(box);
    const xs = [...new Set(lines.flatMap((line) => line.x))].sort((a, b) => a - b);
    const rows = lines.map((line) => {
      const at = new Map(line.x.map((x, index) => [x, line.y[index]]));
      return xs.map((x) => at.has(x) ? at.get(x) : undefined);
    });
    const plot = new uPlot({
      width: Math.max(box.clientWidth, 100), height,
      legend: { show: legend, live: false },
      cursor: { y: false },
      scales: { x: { time: false }, y: range ? { range: () => range } : {} },
      axes: [
        { ...AXIS, size: 30, values: (_, ticks) => ticks.map(short) },
        { ...AXIS, size: 48, space: 18, values: (_, ticks) => ticks.map(format) },
      ],
      series: [{}, ...lines.map((line) => ({
        label: line.label, stroke: line.colour, width: 1.6, dash: line.dash, spanGaps: true, points: { show: Boolean(line.dash) || line.x.length < 2 },
      }))],
    }, [xs, ...rows], box);
    charts.push({ plot, box, height });
    return plot;
  }

  function drawCurves() {
    const place = byId("curves"), several = data.runs.length > 1;
    const lines = (key, mark, dash) => data.runs.filter((run) => run.curves[key]?.x.length).map((run) => ({
      label: several ? `${run.name}${mark}` : key, colour: run.colour, dash, ...run.curves[key],
    }));
    const returns = lines("return", ""), success = lines("success", "");
    const validation = lines("validation", " (validation)", [5, 4]);
    if (!returns.length && !validation.length) {
      place.append(make("p", "There are no metrics of training in this folder."));
      return;
    }
    const windows = [...new Set(data.runs.map((run) => run.curves.window).filter(Boolean))].join(", ");
    const mean = `running mean of ${windows} episodes`;
    chart(place, `Return over decisions, ${mean}`, returns, { height: 230 });
    const percent = (value) => `${Math.round(100 * value)} %`;
    chart(place, `Success over decisions, ${mean}; validation dashed`, [...success, ...validation], { height: 230, format: percent, range: [0, 1.02] });
  }

  // ------------------------------------------------------------------ the player

  const state = { run: 0, flight: 0, time: 0, playing: false, speed: 1, last: 0, opening: false };
  let view = null;
  const panels = new Panels(byId("panels"));
  let traces = [];

  try {
    view = new View(byId("canvas"));
  } catch (error) {
    byId("view").replaceChildren(make("p", "This browser has no WebGL, so the flights cannot be drawn in 3D.", { className: "failed" }));
  }

  const chosen = () => data.runs[state.run].flights[state.flight];

  function choose(run, flight) {
    state.run = run;
    state.flight = flight;
    state.time = 0;
    state.opening = false;
    const of = data.runs[run], here = chosen();
    rowsOf(here);
    byId("run").value = run;
    const list = byId("flight");
    if (list.dataset.run !== String(run)) {
      list.dataset.run = run;
      list.replaceChildren(...of.flights.map((each, index) =>
        make("option", `${index + 1}: ${data.outcomes[each.outcome].label}, ${each.seconds.toFixed(1)} s`, { value: index })));
    }
    list.value = flight;
    byId("time").max = here.end;
    panels.show(here);
    showWorld();
    drawTraces(here);
    render();
  }

  function showWorld() {
    const here = chosen(), several = data.runs.length > 1, others = byId("others");
    const flights = data.runs.flatMap((run) => run.flights
      .filter((flight) => flight.world === here.world && (others.checked || flight === here))
      .map((flight) => ({ flight, colour: several ? run.colour : flight === here ? "#0072b2" : data.outcomes[flight.outcome].colour })));
    const ends = several ? [] : [...new Set(flights.filter((each) => each.flight !== here).map((each) => each.flight.outcome))];
    byId("colours").replaceChildren(...ends.map((kind) => {
      const word = make("span", `● ${data.outcomes[kind].label} `);
      word.style.color = data.outcomes[kind].colour;
      return word;
    }));
    view?.show(here.world, flights, here);
  }

  function drawTraces(flight) {
    const place = byId("traces");
    for (const plot of traces) {
      charts.splice(charts.findIndex((each) => each.plot === plot), 1);
      plot.destroy();
    }
    place.replaceChildren();
    const rows = Array.from({ length: flight.count }, (_, row) => row * WIDTH);
    const x = rows.map((row) => flight.table[row]);
    traces = [["Clearance, m", "clearance", "#d55e00"], ["Speed, m/s", "speed", "#0072b2"]].map(([title, name, colour]) => {
      const y = rows.map((row) => flight.table[row + COLUMN[name]]);
      return chart(place, title, [{ label: name, colour, x, y }], { height: 84, legend: false });
    });
    for (const plot of traces) {
      plot.over.addEventListener("click", () => seek(plot.posToVal(plot.cursor.left, "x")));
      const mark = make("div", "", { className: "mark" });
      mark.style.cssText = "position:absolute;top:0;bottom:0;width:2px;background:#222;pointer-events:none";
      plot.over.append(mark);
      plot.mark = mark;
    }
  }

  /** Shows the moment of the chosen flight in which the drone sees most; playing then begins at the start. */
  function open() {
    const { pictures, decision_s: decision } = chosen();
    if (!pictures) return;
    seek((pictures.busiest + 1) * decision);
    state.opening = true;
  }

  function seek(time) {
    state.opening = false;
    state.time = Math.min(Math.max(time, 0), chosen().end);
    render();
  }

  function render() {
    const flight = chosen(), time = state.time;
    byId("time").value = time;
    byId("clock").textContent = `${time.toFixed(1)} / ${flight.end.toFixed(1)} s`;
    byId("play").textContent = state.playing ? "❚❚" : "▶";
    const away = Math.hypot(...["x", "y", "z"].map((name, axis) => valueAt(flight, time, name) - flight.goal[axis]));
    const clear = valueAt(flight, time, "clearance");
    byId("state").textContent = `speed ${valueAt(flight, time, "speed").toFixed(1)} m/s\nclearance ${clear < 1e5 ? Math.max(clear, 0).toFixed(1) + " m" : "unlimited"}\nto the goal ${away.toFixed(0)} m`;
    const ended = time >= flight.end - 1e-3, outcome = data.outcomes[flight.outcome];
    byId("ending").textContent = ended ? (flight.outcome === "goal" ? "goal reached" : outcome.label) : "";
    byId("ending").style.color = outcome.colour;
    panels.draw(time);
    view?.draw(time);
    for (const plot of traces) plot.mark.style.left = `${plot.valToPos(time, "x")}px`;
  }

  function play(on) {
    if (on && (state.opening || state.time >= chosen().end - 1e-3)) state.time = 0;
    state.opening = false;
    state.playing = on;
    state.last = performance.now();
    render();
  }

  function tick(now) {
    if (state.playing) {
      state.time += Math.min((now - state.last) / 1000, 0.25) * state.speed;
      if (state.time >= chosen().end) {
        state.time = chosen().end;
        state.playing = false;
      }
    }
    state.last = now;
    render();
    requestAnimationFrame(tick);
  }

  function step(by) {
    const count = data.runs[state.run].flights.length;
    choose(state.run, (state.flight + by + count) % count);
  }

  function setView(mode) {
    for (const button of document.querySelectorAll("button.view")) button.classList.toggle("on", button.dataset.view === mode);
    view?.setMode(mode);
  }

  byId("run").append(...data.runs.map((run, index) => make("option", run.name, { value: index })));
  byId("run-choice").hidden = data.runs.length < 2;
  byId("run").addEventListener("change", (event) => {
    const run = +event.target.value;
    choose(run, Math.min(state.flight, data.runs[run].flights.length - 1));
  });
  byId("flight").addEventListener("change", (event) => choose(state.run, +event.target.value));
  byId("previous").addEventListener("click", () => step(-1));
  byId("next").addEventListener("click", () => step(1));
  byId("others").addEventListener("change", showWorld);
  byId("play").addEventListener("click", () => play(!state.playing));
  byId("time").addEventListener("input", (event) => seek(+event.target.value));
  byId("speed").addEventListener("change", (event) => { state.speed = +event.target.value; });
  for (const button of document.querySelectorAll("button.view")) button.addEventListener("click", () => setView(button.dataset.view));
  document.addEventListener("keydown", (event) => {
    if (["INPUT", "SELECT", "BUTTON"].includes(event.target.tagName)) return;
    if (event.key === " ") { event.preventDefault(); play(!state.playing); }
    if (event.key === "n") step(1);
    if (event.key === "p") step(-1);
  });
  new ResizeObserver(() => {
    for (const { plot, box, height } of charts) if (box.clientWidth) plot.setSize({ width: box.clientWidth, height });
  }).observe(document.body);

  setView("orbit");
  choose(0, 0);
  open();
  drawCurves();
  requestAnimationFrame(tick);
})();
