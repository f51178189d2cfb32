// The console's modules, for the components that NiceGUI loads one by one.
export { stream } from "./stream.js";
export { CameraRig } from "./camera_rig.js";
export { COLOUR_MAPS, gradient } from "./colours.js";
export { GraphLines } from "./graph_lines.js";
export { GroundGrid } from "./ground_grid.js";
export { MapTools } from "./map_tools.js";
export { PointCloud } from "./point_cloud.js";
export { RobotModel } from "./robot_model.js";
export { drawScaleBar } from "./scale_bar.js";
