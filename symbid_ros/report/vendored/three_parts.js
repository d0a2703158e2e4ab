// The parts of three.js that robot_view.js uses; README.md says how three.min.js is made from them.
export {
  Box3, BufferAttribute, BufferGeometry, CanvasTexture, DirectionalLight, DoubleSide,
  Group, HemisphereLight, Mesh, MeshBasicMaterial, MeshLambertMaterial, PerspectiveCamera,
  Raycaster, Scene, SphereGeometry, Sprite, SpriteMaterial, SRGBColorSpace, Vector2, Vector3, WebGLRenderer,
} from "three";
export { OrbitControls } from "three/addons/controls/OrbitControls.js";
export { LineMaterial } from "three/addons/lines/LineMaterial.js";
export { LineSegments2 } from "three/addons/lines/LineSegments2.js";
export { LineSegmentsGeometry } from "three/addons/lines/LineSegmentsGeometry.js";
export { toCreasedNormals } from "three/addons/utils/BufferGeometryUtils.js";
