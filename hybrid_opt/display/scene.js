"use strict";
/* The cell in three dimensions: nested joint frames, z up, orbit by pointer. */
(function () {
  const COLOURS = { "robot 1": 0x3b6ea8, "robot 2": 0xa8733b, payload: 0xc9a227,
    environment: 0x9aa3ab, ground: 0xdedfd8, marked: 0xb00020 };
  const ARROW = 0.35; /* Length of the largest force [m]. */

  function matrix(rows) {
    return new THREE.Matrix4().set(...rows);
  }

  function fixedGroup(rows) {
    const group = new THREE.Group();
    group.matrixAutoUpdate = false;
    group.matrix.copy(matrix(rows));
    return group;
  }

  function decode(text, Type) {
    const binary = atob(text);
    const bytes = new Uint8Array(binary.length);
    for (let i = 0; i < binary.length; i += 1) bytes[i] = binary.charCodeAt(i);
    return new Type(bytes.buffer);
  }

  /* Samples of a motion, rows of so many numbers, the first of which is the time. */
  class Samples {
    constructor(text, width) {
      const flat = decode(text, Float32Array);
      this.rows = [];
      for (let i = 0; i < flat.length; i += width) this.rows.push(flat.subarray(i, i + width));
      this.times = this.rows.map((row) => row[0]);
      this.end = this.times[this.times.length - 1];
      /* Of the box's centre. */
      this.path = new Float32Array(3 * this.rows.length);
      this.rows.forEach((row, i) => this.path.set(row.subarray(1, 4), 3 * i));
    }

    /* The row at a time, mixed of its neighbours, and the number of the nearer one. */
    at(time) {
      let k = 0;
      while (k < this.rows.length - 2 && this.times[k + 1] < time) k += 1;
      const [a, b] = [this.rows[k], this.rows[k + 1]];
      const share = b[0] > a[0] ? Math.min(1, (time - a[0]) / (b[0] - a[0])) : 0;
      const row = a.map((value, i) => value + share * (b[i] - value));
      return { row, nearest: share < 0.5 ? k : k + 1 };
    }
  }

  /* Where one looks from at first [rad]. */
  const AZIMUTH = (-152 * Math.PI) / 180, ELEVATION = (24 * Math.PI) / 180;

  class CellScene {
    constructor(element, data) {
      this.element = element;
      this.data = data;
      this.renderer = new THREE.WebGLRenderer({ antialias: true, alpha: true });
      this.renderer.setPixelRatio(Math.min(window.devicePixelRatio || 1, 2));
      element.appendChild(this.renderer.domElement);
      this.scene = new THREE.Scene();
      this.grounds = [];
      this.scene.add(new THREE.HemisphereLight(0xffffff, 0x9a9a92, 0.75));
      const sun = new THREE.DirectionalLight(0xffffff, 0.55);
      sun.position.set(-2.5, 1.8, 4);
      this.scene.add(sun);
      this.camera = new THREE.PerspectiveCamera(35, 1, 0.05, 60);
      this.camera.up.set(0, 0, 1);
      this.box = new THREE.Group();
      this.scene.add(this.box);
      this.arms = data.arms.map((arm) => this.makeArm(arm));
      data.solids.forEach((solid) => this.addSolid(solid));
      this.arrows = data.contacts.map(({ along }) => {
        const arrow = new THREE.ArrowHelper(new THREE.Vector3(...along), undefined, ARROW, COLOURS.marked);
        arrow.visible = false;
        /* The pads would hide them. */
        [arrow.line, arrow.cone].forEach((part) => {
          part.material.depthTest = false;
          part.renderOrder = 1;
        });
        this.box.add(arrow);
        return arrow;
      });
      this.path = new THREE.Line(new THREE.BufferGeometry(),
        new THREE.LineBasicMaterial({ color: 0xb00020 }));
      this.path.frustumCulled = false;
      this.scene.add(this.path);
      this.resetView();
      this.listen();
      new ResizeObserver(() => this.resize()).observe(element);
      this.resize();
    }

    makeArm(arm) {
      const root = fixedGroup(arm.root);
      this.scene.add(root);
      let parent = root;
      return arm.origins.map((origin, j) => {
        const fixed = fixedGroup(origin);
        const moving = new THREE.Group();
        parent.add(fixed);
        fixed.add(moving);
        parent = moving;
        return { moving, turns: arm.turning[j], axis: new THREE.Vector3(...arm.axes[j]) };
      });
    }

    addSolid(solid) {
      const positions = decode(solid.vertices, Float32Array);
      const geometry = new THREE.BufferGeometry();
      geometry.setAttribute("position", new THREE.BufferAttribute(positions, 3));
      geometry.setIndex(new THREE.BufferAttribute(decode(solid.faces, Uint16Array), 1));
      const flat = geometry.toNonIndexed();
      flat.computeVertexNormals();
      const colour = COLOURS[solid.ground && solid.group !== "marked" ? "ground" : solid.group];
      const mesh = new THREE.Mesh(flat, new THREE.MeshLambertMaterial({ color: colour }));
      if (colour === COLOURS.ground) this.grounds.push(mesh);
      if (solid.kind === "world") this.scene.add(mesh);
      else if (solid.kind === "box") this.box.add(mesh);
      else this.arms[solid.robot][solid.joint].moving.add(mesh);
    }

    /* The ground as dark as the page around; the background is the element's own. */
    dim(dark) {
      this.grounds.forEach((mesh) => mesh.material.color.setHex(dark ? 0x3b444b : COLOURS.ground));
      this.render();
    }

    /* pose: x y z and the orientation; q: all joints, the second arm's after the first's; forces:
       of both arms on the box as shares of what the longest arrow stands for. */
    place(pose, q, forces = []) {
      forces.forEach((share, i) => {
        const { at, along } = this.data.contacts[i], length = ARROW * share;
        this.arrows[i].visible = share > 0.01;
        this.arrows[i].setLength(Math.max(length, 1e-3), 0.3 * length, 0.16 * length);
        this.arrows[i].position.set(...at.map((value, k) => value - length * along[k]));
      });
      this.box.position.set(pose[0], pose[1], pose[2]);
      this.turn(pose[3], pose[4], pose[5]);
      this.arms.flat().forEach((joint, k) => {
        if (joint.turns) joint.moving.quaternion.setFromAxisAngle(joint.axis, q[k]);
        else joint.moving.position.copy(joint.axis).multiplyScalar(q[k]);
      });
      this.render();
    }

    /* Roll, pitch, yaw, or a rotation vector that turns the reference. */
    turn(a, b, c) {
      const { vector, reference } = this.data.orientation;
      if (!vector) {
        this.box.rotation.set(a, b, c, "ZYX");
        return;
      }
      const axis = new THREE.Vector3(a, b, c), angle = axis.length();
      this.box.quaternion.setFromAxisAngle(axis.normalize(), angle)
        .multiply(new THREE.Quaternion(...reference));
    }

    showPath(points) {
      this.path.geometry.dispose();
      this.path.geometry = new THREE.BufferGeometry();
      this.path.geometry.setAttribute("position", new THREE.BufferAttribute(points, 3));
    }

    resetView() {
      const { lower, upper } = this.data.view;
      this.target = new THREE.Vector3(...lower.map((low, k) => (low + upper[k]) / 2));
      this.azimuth = AZIMUTH;
      this.elevation = ELEVATION;
      this.distance = this.fitted = this.fit();
      this.render();
    }

    /* The distance from which the box around both arms and the payload fills the picture. */
    fit() {
      const { lower, upper } = this.data.view;
      const flat = Math.cos(ELEVATION), slope = Math.tan((this.camera.fov * Math.PI) / 360);
      const towards = [flat * Math.cos(AZIMUTH), flat * Math.sin(AZIMUTH), Math.sin(ELEVATION)];
      const right = [-Math.sin(AZIMUTH), Math.cos(AZIMUTH), 0];
      const up = [-Math.sin(ELEVATION) * Math.cos(AZIMUTH), -Math.sin(ELEVATION) * Math.sin(AZIMUTH), flat];
      const along = (axis, v) => axis[0] * v[0] + axis[1] * v[1] + axis[2] * v[2];
      const needed = [...Array(8).keys()].map((corner) => {
        const v = lower.map((low, k) => ((corner >> k) & 1 ? 0.5 : -0.5) * (upper[k] - low));
        const [x, y] = [Math.abs(along(right, v)) / this.camera.aspect, Math.abs(along(up, v))];
        return along(towards, v) + Math.max(x, y) / slope;
      });
      return 1.03 * Math.max(...needed);
    }

    resize() {
      const width = Math.max(1, this.element.clientWidth);
      const height = Math.max(1, this.element.clientHeight);
      this.renderer.setSize(width, height);
      this.camera.aspect = width / height;
      this.camera.updateProjectionMatrix();
      const before = this.fitted;
      this.fitted = this.fit();
      this.distance *= this.fitted / before;
      this.render();
    }

    render() {
      const flat = this.distance * Math.cos(this.elevation);
      this.camera.position.set(
        this.target.x + flat * Math.cos(this.azimuth),
        this.target.y + flat * Math.sin(this.azimuth),
        this.target.z + this.distance * Math.sin(this.elevation));
      this.camera.lookAt(this.target);
      this.renderer.render(this.scene, this.camera);
    }

    orbit(dx, dy) {
      this.azimuth -= 0.008 * dx;
      this.elevation = Math.min(1.55, Math.max(-1.2, this.elevation + 0.008 * dy));
      this.render();
    }

    pan(dx, dy) {
      const step = (this.distance * 1.2) / this.element.clientHeight / 2;
      const right = new THREE.Vector3().setFromMatrixColumn(this.camera.matrix, 0);
      const up = new THREE.Vector3().setFromMatrixColumn(this.camera.matrix, 1);
      this.target.addScaledVector(right, -dx * step).addScaledVector(up, dy * step);
      this.render();
    }

    zoom(factor) {
      this.distance = Math.min(40, Math.max(0.3, this.distance * factor));
      this.render();
    }

    listen() {
      const pointers = new Map();
      const spread = () => {
        const [a, b] = [...pointers.values()];
        return Math.hypot(a.x - b.x, a.y - b.y);
      };
      const canvas = this.renderer.domElement;
      canvas.addEventListener("pointerdown", (event) => {
        canvas.setPointerCapture(event.pointerId);
        pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
      });
      canvas.addEventListener("pointermove", (event) => {
        const last = pointers.get(event.pointerId);
        if (!last) return;
        const before = pointers.size === 2 ? spread() : 0;
        const [dx, dy] = [event.clientX - last.x, event.clientY - last.y];
        pointers.set(event.pointerId, { x: event.clientX, y: event.clientY });
        if (before > 0) this.zoom(before / Math.max(1, spread()));
        else if (event.buttons & 2 || event.shiftKey) this.pan(dx, dy);
        else this.orbit(dx, dy);
      });
      const release = (event) => pointers.delete(event.pointerId);
      canvas.addEventListener("pointerup", release);
      canvas.addEventListener("pointercancel", release);
      canvas.addEventListener("contextmenu", (event) => event.preventDefault());
      const keys = { ArrowLeft: () => this.orbit(-25, 0), ArrowRight: () => this.orbit(25, 0),
        ArrowUp: () => this.orbit(0, 25), ArrowDown: () => this.orbit(0, -25),
        "+": () => this.zoom(0.9), "-": () => this.zoom(1.1), Home: () => this.resetView() };
      this.element.addEventListener("keydown", (event) => {
        if (!keys[event.key]) return;
        event.preventDefault();
        keys[event.key]();
      });
      canvas.addEventListener("wheel", (event) => {
        event.preventDefault();
        this.zoom(Math.exp(0.001 * event.deltaY));
      }, { passive: false });
    }
  }

  window.CellScene = CellScene;
  window.Samples = Samples;
})();
