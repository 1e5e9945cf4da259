// PlayCanvas with GSPLATDATA_LARGE and minPixelSize 0, so that it keeps scales as halves and draws all dots, for `mi-splat conform --browser`; see ../README.md.
import { draw } from "./draw.js";

export const run = (...given) => draw(...given, { precise: true });
