// PlayCanvas as it is by default, for `mi-splat conform --browser`; see ../README.md.
import { draw } from "./draw.js";

export const run = (...given) => draw(...given, { precise: false });
