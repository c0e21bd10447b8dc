// Unpacks the browser in the npm package @sparticuz/chromium: `node unpack.mjs PACKAGE FOLDER`.

import { createReadStream, createWriteStream } from "node:fs";
import { pipeline } from "node:stream/promises";
import { createBrotliDecompress } from "node:zlib";

const [folder, out] = process.argv.slice(2);
for (const name of ["chromium", "al2023.tar", "swiftshader.tar", "fonts.tar"])
  await pipeline(createReadStream(`${folder}/bin/${name}.br`), createBrotliDecompress(), createWriteStream(`${out}/${name}`));
