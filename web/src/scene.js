// The twin in WebGL: Gaussians a part, posed by the joints; drawn when something changed and not before.
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import { axisOf } from "./axes.js";
import { tinted } from "./tint.js";

const FOV = 30;
const MARGIN = 1.12; // of the picture, around the outline of the twin
const BLUR = 0.3; // square pixels that the rasteriser adds to every Gaussian

function decoded(base64) {
  return Uint8Array.from(atob(base64), (c) => c.charCodeAt(0));
}

// The motion of a joint at a value, as Joint.transform of the Python package has it.
function motion(joint, value) {
  const T = new THREE.Matrix4();
  const axis = new THREE.Vector3(...joint.axis);
  if (joint.type === "prismatic") return T.setPosition(axis.multiplyScalar(value));
  if (joint.type !== "revolute") return T;
  const pivot = new THREE.Vector3(...joint.pivot);
  T.makeRotationAxis(axis, value);
  return T.setPosition(pivot.clone().sub(pivot.clone().applyMatrix4(T)));
}

export async function openScene(stage, twin) {
  const canvas = stage.querySelector("canvas");
  const context = canvas.getContext("webgl2", { alpha: true, antialias: false, premultipliedAlpha: true });
  if (!context) throw new Error("This browser offers no WebGL 2, so the twin cannot move here; the pictures remain.");
  const renderer = new THREE.WebGLRenderer({ canvas, context, alpha: true, antialias: false });
  renderer.setClearColor(0, 0);
  renderer.setPixelRatio(Math.min(devicePixelRatio, 2));

  const scene = new THREE.Scene();
  const camera = new THREE.PerspectiveCamera(FOV, 1, 0.01, 100);
  camera.up.set(...twin.up);

  // One frame, and more while Spark sorts; data-still says that the picture is final.
  let wanted = false;
  let loaded = false;
  function want() {
    delete stage.dataset.still;
    if (wanted) return;
    wanted = true;
    requestAnimationFrame(() => {
      wanted = false;
      soften();
      renderer.render(scene, camera);
      stage.dataset.frames = Number(stage.dataset.frames ?? 0) + 1;
      if (!loaded || spark.sorting || spark.sortDirty) return;
      stage.dataset.still = "";
      stage.removeAttribute("aria-busy");
    });
  }

  const spark = new SparkRenderer({ renderer, onDirty: want, sortRadial: false, preBlurAmount: BLUR, blurAmount: 0 });
  scene.add(spark);

  // What a pixel of the photographs blurs stays as soft where the screen has more pixels for it.
  function soften() {
    const pixel = (2 * Math.tan((FOV / 2) * (Math.PI / 180)) * camera.position.distanceTo(controls.target)) / canvas.height;
    spark.preBlurAmount = BLUR * Math.max(1, twin.pixel / pixel) ** 2;
  }

  const parts = new Map();
  for (const part of twin.parts.filter(({ spz }) => spz)) {
    const group = new THREE.Group();
    group.matrixAutoUpdate = false;
    scene.add(group);
    const tint = tinted(new THREE.Color().setStyle(part.colour, THREE.LinearSRGBColorSpace));
    const splats = new SplatMesh({ fileBytes: decoded(part.spz), fileType: "spz", objectModifier: tint.modifier });
    group.add(splats);
    parts.set(part.id, { group, splats, tint, axis: null });
  }
  const joints = new Map(twin.joints.map((joint) => [joint.child, joint]));
  for (const joint of twin.joints) {
    if (joint.type === "fixed" || !parts.has(joint.child)) continue;
    const axis = axisOf(joint, twin.parts.find((p) => p.id === joint.child).colour, twin.size);
    axis.visible = false;
    scene.add(axis);
    parts.get(joint.child).axis = axis;
  }

  function pose(values) {
    const poses = new Map();
    function of(id) {
      if (poses.has(id)) return poses.get(id);
      const T = new THREE.Matrix4();
      const joint = joints.get(id);
      if (joint) {
        const unit = joint.type === "prismatic" ? twin.size : 1;
        T.multiplyMatrices(of(joint.parent), motion(joint, values.get(id) / unit));
      }
      poses.set(id, T);
      return T;
    }
    for (const [id, { group, axis }] of parts) {
      group.matrix.copy(of(id));
      if (axis) axis.matrix.copy(of(joints.get(id).parent));
    }
    scene.updateMatrixWorld(true);
    want();
  }

  const controls = new OrbitControls(camera, canvas);
  controls.enableDamping = false;
  controls.rotateSpeed = 0.8;
  controls.minDistance = 0.5;
  controls.maxDistance = 20;
  controls.addEventListener("change", want);
  // A wheel turns the page until the picture has been touched; a finger moves it up and down throughout.
  controls.enableZoom = false;
  canvas.addEventListener("pointerdown", () => canvas.focus());
  canvas.addEventListener("focus", () => (controls.enableZoom = true));
  canvas.addEventListener("blur", () => (controls.enableZoom = false));
  if (matchMedia("(pointer: coarse)").matches) canvas.style.touchAction = "pan-y";

  canvas.addEventListener("keydown", (event) => {
    const step = 0.1;
    const moves = {
      ArrowLeft: [-step, 0, 1],
      ArrowRight: [step, 0, 1],
      ArrowUp: [0, -step, 1],
      ArrowDown: [0, step, 1],
      "+": [0, 0, 1 / 1.1],
      "=": [0, 0, 1 / 1.1],
      "-": [0, 0, 1.1],
    };
    const move = moves[event.key];
    if (!move || event.ctrlKey || event.metaKey) return;
    event.preventDefault();
    const toY = new THREE.Quaternion().setFromUnitVectors(camera.up, new THREE.Vector3(0, 1, 0));
    const offset = camera.position.clone().sub(controls.target).applyQuaternion(toY);
    const ball = new THREE.Spherical().setFromVector3(offset);
    ball.theta += move[0];
    ball.phi += move[1];
    ball.radius *= move[2];
    ball.makeSafe();
    camera.position.setFromSpherical(ball).applyQuaternion(toY.invert()).add(controls.target);
    controls.update();
    want();
  });

  let untouched = true;
  // From the side that the photograph shows, as near as the outline of the twin with its joints at their ends allows.
  function resetView() {
    const from = new THREE.Vector3(...twin.from).normalize();
    camera.position.copy(from);
    camera.lookAt(0, 0, 0);
    const toCamera = camera.quaternion.clone().invert();
    const points = twin.outline.map((point) => new THREE.Vector3(...point).applyQuaternion(toCamera));
    // |p - middle| <= slope (distance - p.z) for every point, and equal for one on either side.
    function fit(side, slope) {
      const most = Math.max(...points.map((p) => p[side] + slope * p.z));
      const least = Math.max(...points.map((p) => -p[side] + slope * p.z));
      return [(most - least) / 2, (most + least) / 2 / slope];
    }
    const slope = Math.tan((FOV / 2) * (Math.PI / 180)) / MARGIN;
    const [x, wide] = fit("x", slope * camera.aspect);
    const [y, high] = fit("y", slope);
    untouched = true;
    controls.target.set(x, y, 0).applyQuaternion(camera.quaternion);
    camera.position.copy(controls.target).addScaledVector(from, Math.max(wide, high, 1));
    controls.update();
    want();
  }

  controls.addEventListener("start", () => (untouched = false));
  new ResizeObserver(() => {
    const { clientWidth, clientHeight } = stage;
    if (!clientWidth || !clientHeight) return;
    renderer.setSize(clientWidth, clientHeight, false);
    camera.aspect = clientWidth / clientHeight;
    camera.updateProjectionMatrix();
    if (untouched) resetView();
    want();
  }).observe(stage);

  await Promise.all([...parts.values()].map(({ splats }) => splats.initialized));
  loaded = true;
  want();
  return {
    pose,
    resetView,
    showAxes(on) {
      for (const { axis } of parts.values()) if (axis) axis.visible = on;
      want();
    },
    showParts(on) {
      for (const { tint, splats } of parts.values()) {
        tint.amount.value = on ? 1 : 0;
        splats.updateVersion();
      }
      want();
    },
  };
}
