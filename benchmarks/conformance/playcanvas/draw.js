// What both adapters of PlayCanvas do.
import * as pc from "playcanvas";

export async function draw(url, camera, canvas, settled, { precise }) {
  const app = new pc.Application(canvas, {
    graphicsDeviceOptions: { antialias: false, preserveDrawingBuffer: true, alpha: false },
  });
  app.graphicsDevice.maxPixelRatio = 1;
  app.setCanvasResolution(pc.RESOLUTION_FIXED, ...camera.size);
  app.start();
  const asset = new pc.Asset(camera.name, "gsplat", { url });
  app.assets.add(asset);
  await new Promise((done, fail) => {
    asset.ready(done);
    asset.once("error", fail);
    app.assets.load(asset);
  });
  if (precise) {
    app.scene.gsplat.dataFormat = pc.GSPLATDATA_LARGE;
    app.scene.gsplat.minPixelSize = 0;
  }
  const splat = new pc.Entity();
  splat.addComponent("gsplat", { asset });
  app.root.addChild(splat);

  const view = new pc.Entity();
  view.addComponent("camera", {
    clearColor: new pc.Color(...camera.background, 1),
    toneMapping: pc.TONEMAP_NONE,
    gammaCorrection: pc.GAMMA_SRGB,
    calculateProjection: (matrix) => matrix.data.set(camera.gl_projection),
  });
  const pose = new pc.Mat4().set(camera.gl_view).invert();
  view.setLocalPosition(pose.getTranslation());
  view.setLocalRotation(new pc.Quat().setFromMat4(pose));
  app.root.addChild(view);
  const image = await settled(() => app.render());
  app.destroy();
  return image;
}
