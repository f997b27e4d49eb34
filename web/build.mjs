// Bundles src/main.js with three and Spark into the one file that the Python package ships.
import { build } from "esbuild";
import { readFileSync } from "node:fs";

const packages = ["three", "@sparkjsdev/spark", "fflate"];
const notices = packages.map(
  (name) => `${name}\n\n${readFileSync(`node_modules/${name}/LICENSE`, "utf8").trim()}`,
);

await build({
  entryPoints: ["src/main.js"],
  outfile: "../src/hingesplat/report/bundle.js",
  bundle: true,
  minify: true,
  format: "iife",
  target: "es2022",
  charset: "ascii",
  legalComments: "none",
  define: { "import.meta.url": '"about:blank"' },
  banner: { js: `/*\n${notices.join("\n\n---\n\n").replaceAll("*/", "* /")}\n*/` },
});
