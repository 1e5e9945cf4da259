// Spark for `mi-splat conform --browser`; see ../README.md.
import { SparkRenderer, SplatMesh } from "@sparkjsdev/spark";
import * as THREE from "three";

export async function run(url, camera, canvas, settled) {
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: false, preserveDrawingBuffer: true });
  renderer.setSize(...camera.size, false);
  const scene = new THREE.Scene();
  scene.background = new THREE.Color().setRGB(...camera.background, THREE.SRGBColorSpace);
  const view = new THREE.PerspectiveCamera();
  const pose = new THREE.Matrix4().fromArray(camera.gl_view).invert();
  pose.decompose(view.position, view.quaternion, view.scale);
  view.updateMatrixWorld(true);
  view.projectionMatrix.fromArray(camera.gl_projection);
  view.projectionMatrixInverse.copy(view.projectionMatrix).invert();
  const spark = new SparkRenderer({ renderer });
  const splats = new SplatMesh({ url });
  scene.add(spark, splats);
  await splats.initialized;
  const image = await settled(() => renderer.render(scene, view));
  splats.dispose();
  spark.dispose?.();
  renderer.forceContextLoss();
  return image;
}
