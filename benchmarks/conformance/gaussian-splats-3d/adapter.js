// gaussian-splats-3d for `mi-splat conform --browser`; see ../README.md.
import * as GS from "@mkkellogg/gaussian-splats-3d";
import * as THREE from "three";

export async function run(url, camera, canvas, settled) {
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: false, preserveDrawingBuffer: true });
  renderer.setSize(...camera.size, false);
  renderer.setClearColor(new THREE.Color().setRGB(...camera.background, THREE.SRGBColorSpace), 1);
  const view = new THREE.PerspectiveCamera();
  const pose = new THREE.Matrix4().fromArray(camera.gl_view).invert();
  pose.decompose(view.position, view.quaternion, view.scale);
  view.updateMatrixWorld(true);
  view.projectionMatrix.fromArray(camera.gl_projection);
  view.projectionMatrixInverse.copy(view.projectionMatrix).invert();
  const viewer = new GS.Viewer({
    renderer,
    camera: view,
    selfDrivenMode: false,
    useBuiltInControls: false,
    gpuAcceleratedSort: false,
    optimizeSplatData: false, // the last Gaussian gets a wrong shape, and by default it is any one of the file
    sharedMemoryForWorkers: false,
    sphericalHarmonicsDegree: 2,
    ignoreDevicePixelRatio: true,
    sceneRevealMode: GS.SceneRevealMode.Instant,
    logLevel: GS.LogLevel.None,
  });
  await viewer.addSplatScene(url, { showLoadingUI: false, progressiveLoad: false, splatAlphaRemovalThreshold: 0 });
  const image = await settled(() => {
    viewer.update();
    viewer.render();
  });
  await viewer.dispose();
  renderer.forceContextLoss();
  return image;
}
