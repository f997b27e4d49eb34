// A joint to look at: its axis as an arrow, and the range it was seen in as an arc or a bar.
import * as THREE from "three";

const THIN = 0.008;

function between(a, b, radius, material) {
  const way = b.clone().sub(a);
  const mesh = new THREE.Mesh(new THREE.CylinderGeometry(radius, radius, way.length(), 12), material);
  mesh.position.copy(a).addScaledVector(way, 0.5);
  mesh.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), way.normalize());
  return mesh;
}

function head(at, axis, material) {
  const mesh = new THREE.Mesh(new THREE.ConeGeometry(4 * THIN, 12 * THIN, 20), material);
  mesh.position.copy(at).addScaledVector(axis, 6 * THIN);
  mesh.quaternion.setFromUnitVectors(new THREE.Vector3(0, 1, 0), axis);
  return mesh;
}

export function axisOf(joint, colour, size) {
  const material = new THREE.MeshBasicMaterial({ color: colour, depthTest: false, transparent: true });
  const axis = new THREE.Vector3(...joint.axis);
  const pivot = new THREE.Vector3(...joint.pivot);
  const group = new THREE.Group();
  group.matrixAutoUpdate = false;
  const [low, high] = joint.limits;
  if (joint.type === "revolute") {
    const ends = [-0.55, 0.55].map((t) => pivot.clone().addScaledVector(axis, t));
    group.add(between(ends[0], ends[1], THIN, material), head(ends[1], axis, material));
    const faint = material.clone();
    faint.opacity = 0.3;
    const arc = new THREE.Mesh(new THREE.RingGeometry(0, 0.3, 48, 1, 0, high - low), faint);
    faint.side = THREE.DoubleSide;
    arc.position.copy(pivot);
    // The sector starts where the part's outward direction is at its lowest value.
    const out = new THREE.Vector3(...joint.outward);
    const x = out.addScaledVector(axis, -out.dot(axis)).normalize().applyAxisAngle(axis, low);
    arc.quaternion.setFromRotationMatrix(new THREE.Matrix4().makeBasis(x, axis.clone().cross(x), axis));
    group.add(arc);
  } else {
    const ends = [low, high].map((v) => pivot.clone().addScaledVector(axis, v / size));
    const tip = ends[1].clone().addScaledVector(axis, 0.25);
    group.add(between(ends[0], tip, THIN, material), head(tip, axis, material));
    group.add(between(ends[0], ends[1], 2.5 * THIN, material));
  }
  group.traverse((mesh) => (mesh.renderOrder = 10));
  return group;
}
