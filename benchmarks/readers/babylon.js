import { FreeCamera } from "@babylonjs/core/Cameras/freeCamera";
import { Engine } from "@babylonjs/core/Engines/engine";
import { ImportMeshAsync } from "@babylonjs/core/Loading/sceneLoader";
import { Color4 } from "@babylonjs/core/Maths/math.color";
import { Quaternion, Vector3 } from "@babylonjs/core/Maths/math.vector";
import { Scene } from "@babylonjs/core/scene";
import "@babylonjs/loaders/glTF";

window.draw = async (url, light, camera, width, height) => {
  const canvas = Object.assign(document.createElement("canvas"), { width, height });
  document.body.append(canvas);
  const scene = new Scene(new Engine(canvas, false, { preserveDrawingBuffer: true }));
  scene.useRightHandedSystem = true;
  scene.clearColor = new Color4(0, 0, 0, 1);
  const onParsed = ({ json }) => (json.scene = light);
  await ImportMeshAsync(url, scene, { pluginExtension: ".glb", pluginOptions: { gltf: { onParsed } } });
  const eye = new FreeCamera("eye", new Vector3(...camera.translation), scene);
  eye.rotationQuaternion = new Quaternion(...camera.rotation);
  Object.assign(eye, { fov: camera.yfov, minZ: camera.znear, maxZ: 1000 });
  scene.activeCamera = eye;
  for (let frame = 0; frame < 40; frame += 1) {
    scene.render();
    await new Promise((done) => setTimeout(done, 40)); // splats are sorted by a worker
  }
  scene.render();
  return canvas.toDataURL("image/png");
};
