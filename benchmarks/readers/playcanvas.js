import * as pc from "playcanvas";

window.draw = async (url, light, camera, width, height) => {
  const canvas = document.createElement("canvas");
  document.body.append(canvas);
  const options = new pc.AppOptions();
  options.graphicsDevice = await pc.createGraphicsDevice(canvas, { deviceTypes: ["webgl2"], antialias: false });
  options.graphicsDevice.maxPixelRatio = 1;
  options.componentSystems = [
    pc.RenderComponentSystem, pc.CameraComponentSystem, pc.LightComponentSystem, pc.GSplatComponentSystem,
  ];
  options.resourceHandlers = [pc.ContainerHandler, pc.GSplatHandler, pc.TextureHandler];
  const app = new pc.AppBase(canvas);
  app.init(options);
  app.setCanvasResolution(pc.RESOLUTION_FIXED, width, height);
  app.start();
  const asset = new pc.Asset("scene", "container", { url });
  app.assets.add(asset);
  await new Promise((done, fail) => {
    asset.ready(done);
    asset.on("error", fail);
    app.assets.load(asset);
  });
  const root = asset.resource.instantiateRenderEntity();
  app.root.addChild(root);
  root.findComponents("camera").forEach((each) => (each.enabled = false));
  root.findComponents("gsplat").forEach((each, number) => (each.entity.enabled = number === light));
  const eye = new pc.Entity();
  eye.addComponent("camera", {
    clearColor: new pc.Color(0, 0, 0), toneMapping: pc.TONEMAP_NONE, gammaCorrection: pc.GAMMA_SRGB,
    fov: (camera.yfov * 180) / Math.PI, nearClip: camera.znear, farClip: 1000, aspectRatioMode: 1,
    aspectRatio: width / height,
  });
  app.root.addChild(eye);
  eye.setPosition(...camera.translation);
  eye.setRotation(new pc.Quat(...camera.rotation));
  for (let frame = 0; frame < 40; frame += 1) await new Promise(requestAnimationFrame);
  await new Promise((done) => setTimeout(done, 1500)); // splats are sorted by a worker
  app.render();
  return canvas.toDataURL("image/png");
};
