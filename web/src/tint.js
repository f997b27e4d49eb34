// Splats in the colour of their part; a little of their own brightness shows the shape, as in pictures.py.
import { dyno } from "@sparkjsdev/spark";

export function tinted(colour) {
  const amount = dyno.dynoFloat(0);
  const rgb = dyno.dynoVec3(colour);
  const modifier = dyno.dynoBlock({ gsplat: dyno.Gsplat }, { gsplat: dyno.Gsplat }, ({ gsplat }) => {
    const paint = new dyno.Dyno({
      inTypes: { gsplat: dyno.Gsplat, amount: "float", tint: "vec3" },
      outTypes: { gsplat: dyno.Gsplat },
      statements: ({ inputs, outputs }) =>
        dyno.unindentLines(`
          ${outputs.gsplat} = ${inputs.gsplat};
          float grey = dot(clamp(${inputs.gsplat}.rgba.rgb, 0.0, 1.0), vec3(1.0 / 3.0));
          vec3 painted = ${inputs.tint} * (0.55 + 0.45 * grey);
          ${outputs.gsplat}.rgba.rgb = mix(${inputs.gsplat}.rgba.rgb, painted, ${inputs.amount});
        `),
    });
    return { gsplat: paint.apply({ gsplat, amount, tint: rgb }).gsplat };
  });
  return { modifier, amount };
}
