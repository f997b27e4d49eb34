// Bundles src/main.js with three and Spark into the one file that the Python package ships.
import { build } from "esbuild";
import { createHash } from "node:crypto";
import { readFileSync, readdirSync, writeFileSync } from "node:fs";

const bundle = "../src/hingesplat/report/bundle.js";
const packages = ["three", "@sparkjsdev/spark", "fflate"];
const notices = packages.map(
  (name) => `${name}\n\n${readFileSync(`node_modules/${name}/LICENSE`, "utf8").trim()}`,
);

await build({
  entryPoints: ["src/main.js"],
  outfile: bundle,
  bundle: true,
  minify: true,
  format: "iife",
  target: "es2022",
  charset: "ascii",
  legalComments: "none",
  banner: { js: `/*\n${notices.join("\n\n---\n\n").replaceAll("*/", "* /")}\n*/` },
});

// What the bundle was made from, as `cd web && sha256sum -c bundle.sha256` checks it: a stale bundle fails a test.
const sources = readdirSync("src").map((name) => `src/${name}`);
const lines = ["build.mjs", "package.json", "package-lock.json", ...sources.sort(), bundle].map(
  (path) => `${createHash("sha256").update(readFileSync(path)).digest("hex")}  ${path}\n`,
);
writeFileSync("bundle.sha256", lines.join(""));
