// The controls of report.html: sliders, play, switches. What they move is in scene.js.
import { openScene } from "./scene.js";

const SWEEP_SECONDS = 5;

const twin = JSON.parse(document.getElementById("twin-data").textContent);
const stage = document.getElementById("stage");
const controls = document.getElementById("controls");
const sliders = [...controls.querySelectorAll("input[type=range]")];
const joints = new Map(twin.joints.map((joint) => [joint.child, joint]));
const values = new Map(twin.joints.map((joint) => [joint.child, 0]));

function words(joint, value) {
  if (joint.type === "revolute") return `${((value * 180) / Math.PI).toFixed(1)}°`;
  return `${value.toFixed(3)} ${twin.unit}`;
}

function show(child, value) {
  const joint = joints.get(child);
  const slider = sliders.find((s) => Number(s.dataset.part) === child);
  values.set(child, value);
  if (!slider) return;
  const [low, high] = joint.limits;
  slider.value = ((value - low) / (high - low || 1)) * slider.max;
  slider.setAttribute("aria-valuetext", words(joint, value));
  slider.nextElementSibling.textContent = words(joint, value);
}

function valueAt(slider) {
  const [low, high] = joints.get(Number(slider.dataset.part)).limits;
  return low + (slider.value / slider.max) * (high - low);
}

function button(name) {
  return controls.querySelector(`[data-do=${name}]`);
}

function toggle(name, act) {
  const it = button(name);
  it.addEventListener("click", () => {
    const on = it.getAttribute("aria-pressed") !== "true";
    it.setAttribute("aria-pressed", on);
    act(on);
  });
}

async function start() {
  const scene = await openScene(stage, twin);
  for (const child of joints.keys()) show(child, 0);
  scene.pose(values);

  let playing = false;
  function play(on) {
    playing = on;
    button("play")?.setAttribute("aria-pressed", on);
    if (!on) return;
    const begun = performance.now();
    const phases = new Map();
    for (const [child, { limits }] of joints) {
      const share = (values.get(child) - limits[0]) / (limits[1] - limits[0] || 1);
      phases.set(child, Math.acos(1 - 2 * Math.min(1, Math.max(0, share))));
    }
    requestAnimationFrame(function frame(now) {
      if (!playing) return;
      const angle = ((now - begun) / 1000 / SWEEP_SECONDS) * 2 * Math.PI;
      for (const [child, { limits }] of joints) {
        const share = (1 - Math.cos(phases.get(child) + angle)) / 2;
        show(child, limits[0] + share * (limits[1] - limits[0]));
      }
      scene.pose(values);
      requestAnimationFrame(frame);
    });
  }

  for (const slider of sliders) {
    slider.addEventListener("input", () => {
      play(false);
      show(Number(slider.dataset.part), valueAt(slider));
      scene.pose(values);
    });
  }
  for (const it of controls.querySelectorAll("[data-state]")) {
    it.addEventListener("click", () => {
      play(false);
      for (const [child, joint] of joints) show(child, joint.states[Number(it.dataset.state)]);
      scene.pose(values);
    });
  }
  button("play")?.addEventListener("click", () => play(!playing));
  if (button("axes")) toggle("axes", scene.showAxes);
  toggle("colours", scene.showParts);
  button("reset").addEventListener("click", scene.resetView);
  for (const it of controls.querySelectorAll("[disabled]")) it.disabled = false;
}

start().catch((error) => {
  stage.dataset.failed = "";
  stage.querySelector(".failed").textContent = error.message;
  stage.removeAttribute("aria-busy");
});
