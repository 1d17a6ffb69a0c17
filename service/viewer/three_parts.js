export {WebGLRenderer,Scene,PerspectiveCamera,BufferGeometry,BufferAttribute,Mesh,MeshLambertMaterial,DirectionalLight,HemisphereLight,Color,Vector3,Fog} from 'three';
