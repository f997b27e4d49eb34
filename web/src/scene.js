// The twin in WebGL: Gaussians a part, posed by the joints; drawn when something changed and not before.
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import { axisOf } from "./axes.js";
import { tinted } from "./tint.js";

const FOV = 32;
const MARGIN = 1.12; // of the ball that holds the object, around it

function decoded(base64) {
  return Uint8Array.from(atob(base64), (c) => c.charCodeAt(0));
}

// The motion of a joint at a value, as Joint.transform of the Python package has it.
export function motion(joint, value) {
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

  let wanted = false;
  function want() {
    if (wanted) return;
    wanted = true;
    requestAnimationFrame(() => {
      wanted = false;
      renderer.render(scene, camera);
      stage.dataset.drawn = Number(stage.dataset.drawn ?? 0) + 1;
    });
  }

  const spark = new SparkRenderer({ renderer, onDirty: want, sortRadial: false, preBlurAmount: 0.3, blurAmount: 0 });
  scene.add(spark);

  const parts = new Map();
  for (const part of twin.parts) {
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
    if (joint.type === "fixed") continue;
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

  function resetView() {
    const from = new THREE.Vector3(...twin.from).normalize();
    const half = (FOV / 2) * (Math.PI / 180);
    const narrow = Math.atan(Math.tan(half) * Math.min(1, camera.aspect));
    controls.target.set(0, 0, 0);
    camera.position.copy(from.multiplyScalar(MARGIN / Math.sin(narrow)));
    controls.update();
    want();
  }

  let untouched = true;
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
  stage.removeAttribute("aria-busy");
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
