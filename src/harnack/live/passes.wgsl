// The passes around a traced kernel: rays of the camera, hits, the light of shaded pictures
// (harnack.rendering.shading), and lines and dots in front of the picture. The constants of shading,
// such as KEY_WRAP, are written before this text: see `passes` in harnack.live.shading_data.

struct PassUniforms {
  eye: vec4f,         // on the stage; w: the number of directions along which the sky is estimated
  right: vec4f,       // a unit vector; w: the width of a pixel at distance 1
  up: vec4f,          // a unit vector; w: the rotation of the directions of the sky
  forward: vec4f,     // a unit vector; w: the length of rays
  key: vec4f,         // the unit vector to the key light; w: the height of the floor
  ground: vec4f,      // the reflectance of the ground; w: 1 where there is a floor
  scale: vec4f,       // of numbers that are shown as colors: low, 1 / (high - low)
  background: vec4f,  // the sRGB color behind pictures of numbers
  canvas_size: vec2f, jitter: vec2f,
  width: u32, height: u32, first: u32, count: u32,
  weight: f32, mode: u32, kind: u32, padding: u32,
}
struct SurfaceUniforms {
  lanes: array<vec4u, 2>,     // the values that the kernel's lanes take: see `write_lanes`
  results: array<vec4u, 2>,   // the places of the kernel's results: see `read_result`
  first_color: u32,           // the number of the first color of the surface
  lane_count: u32, padding_0: u32, padding_1: u32,
}
@group(0) @binding(0) var<uniform> uniforms: PassUniforms;
@group(0) @binding(1) var<uniform> surface: SurfaceUniforms;
@group(0) @binding(2) var<storage, read_write> lanes: array<f32>;
@group(0) @binding(3) var<storage, read> results: array<u32>;
@group(0) @binding(4) var<storage, read_write> hits: array<u32>;
@group(0) @binding(5) var<storage, read_write> sky_visibility: array<f32>;
@group(0) @binding(6) var<storage, read_write> picture: array<vec4f>;
@group(0) @binding(7) var<storage, read> surface_colors: array<vec4f>;
@group(0) @binding(8) var<storage, read> floor_light: array<vec2f>;
@group(0) @binding(9) var<storage, read> light_directions: array<vec4f>;
@group(0) @binding(10) var<storage, read_write> occluded: array<u32>;

// The place of a result that the kernel does not write, because it is 0 for all rays.
const NO_OUTPUT = 99u;
// The results of a kernel.
const RESULT_STATUS = 0u; const RESULT_T = 1u; const RESULT_NORMAL = 2u;
const RESULT_EVALUATIONS = 5u; const RESULT_COLOR = 6u;
// The status of a ray.
const STATUS_MISS = 0u; const STATUS_HIT = 1u; const STATUS_OUT_OF_STEPS = 2u;
// The kind of a hit.
const KIND_NONE = 0u; const KIND_GROUND = 1u; const KIND_SURFACE = 2u; const KIND_OUT_OF_STEPS = 3u;
// The mode of a picture.
const MODE_SHADED = 0u; const MODE_NORMAL = 1u; const MODE_DEPTH = 2u;
const MODE_EVALUATIONS = 3u; const MODE_STATUS = 4u;
const NO_HIT_T = 3.0e38;
const TWO_PI = 6.2831853;

fn ray_direction(pixel: u32) -> vec3f {
  let position = vec2f(f32(pixel % uniforms.width), f32(pixel / uniforms.width)) + uniforms.jitter;
  let offset = (position - 0.5 * vec2f(f32(uniforms.width), f32(uniforms.height))) * uniforms.right.w;
  return normalize(uniforms.forward.xyz + offset.x * uniforms.right.xyz - offset.y * uniforms.up.xyz);
}
fn write_lanes(id: u32, origin: vec3f, direction: vec3f, end: f32) {
  let values = array<f32, 7>(
    origin.x, origin.y, origin.z, direction.x, direction.y, direction.z, end);
  for (var k = 0u; k < surface.lane_count; k++) {
    lanes[k * uniforms.count + id] = values[surface.lanes[k / 4u][k % 4u]];
  }
}
fn read_result(k: u32, id: u32) -> u32 {
  let place = surface.results[k / 4u][k % 4u];
  if (place == NO_OUTPUT) { return 0u; }
  return results[place * uniforms.count + id];
}
fn read_float_result(k: u32, id: u32) -> f32 { return bitcast<f32>(read_result(k, id)); }

// Rays through pixels.
@compute @workgroup_size(64)
fn camera_rays(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= uniforms.count) { return; }
  write_lanes(id.x, uniforms.eye.xyz, ray_direction(uniforms.first + id.x), uniforms.forward.w);
}

// The hits before any surface is traced: the floor, or nothing.
@compute @workgroup_size(64)
fn clear_hits(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= uniforms.count) { return; }
  let pixel = uniforms.first + id.x;
  let direction = ray_direction(pixel);
  var t = NO_HIT_T;
  var kind = KIND_NONE;
  let ground_t = (uniforms.key.w - uniforms.eye.z) / min(direction.z, -1e-9);
  let ground_point = uniforms.eye.xyz + ground_t * direction;
  let has_ground = uniforms.ground.w > 0.5 && uniforms.mode == MODE_SHADED;
  if (has_ground && direction.z < 0.0 && length(ground_point.xy) < FLOOR_RADIUS) {
    t = ground_t; kind = KIND_GROUND;
  }
  write_hit(pixel, t, direction, vec3f(0.0, 0.0, 1.0), kind);
}

// A hit has eight words: its position, t, its normal, and the info word. This has, from the lowest
// bit on: the kind (2 bits), whether the side of larger values is seen (1), the number of the color
// (11), and the number of evaluations (18).
fn write_hit(pixel: u32, t: f32, direction: vec3f, normal: vec3f, info: u32) {
  let position = uniforms.eye.xyz + t * direction;
  let start = 8u * pixel;
  hits[start] = bitcast<u32>(position.x); hits[start + 1u] = bitcast<u32>(position.y);
  hits[start + 2u] = bitcast<u32>(position.z); hits[start + 3u] = bitcast<u32>(t);
  hits[start + 4u] = bitcast<u32>(normal.x); hits[start + 5u] = bitcast<u32>(normal.y);
  hits[start + 6u] = bitcast<u32>(normal.z); hits[start + 7u] = info;
}
fn hit_position(pixel: u32) -> vec3f {
  let start = 8u * pixel;
  return vec3f(bitcast<f32>(hits[start]), bitcast<f32>(hits[start + 1u]), bitcast<f32>(hits[start + 2u]));
}
fn hit_t(pixel: u32) -> f32 { return bitcast<f32>(hits[8u * pixel + 3u]); }
fn hit_normal(pixel: u32) -> vec3f {
  let start = 8u * pixel + 4u;
  return vec3f(bitcast<f32>(hits[start]), bitcast<f32>(hits[start + 1u]), bitcast<f32>(hits[start + 2u]));
}
fn hit_normal_to_eye(pixel: u32, direction: vec3f) -> vec3f {
  let normal = hit_normal(pixel);
  return select(normal, -normal, dot(normal, direction) > 0.0);
}
fn hit_info(pixel: u32) -> u32 { return hits[8u * pixel + 7u]; }
fn hit_kind(info: u32) -> u32 { return info & 3u; }
fn is_visible(pixel: u32) -> bool {
  let kind = hit_kind(hit_info(pixel));
  return kind == KIND_GROUND || kind == KIND_SURFACE;
}

// Merges the results of one surface into the hits: they replace those that are farther.
@compute @workgroup_size(64)
fn merge_hits(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= uniforms.count) { return; }
  let pixel = uniforms.first + id.x;
  let old_info = hit_info(pixel);
  let old_kind = hit_kind(old_info);
  let evaluations = min((old_info >> 14u) + read_result(RESULT_EVALUATIONS, id.x), 0x3ffffu) << 14u;
  let status = read_result(RESULT_STATUS, id.x);
  let direction = ray_direction(pixel);
  let t = read_float_result(RESULT_T, id.x);
  if (status == STATUS_OUT_OF_STEPS) {
    write_hit(pixel, t, direction, -direction, KIND_OUT_OF_STEPS | evaluations);
    return;
  }
  // The floor stands below the first state: it hides no surface that has moved below it.
  let is_in_front = old_kind == KIND_GROUND || t < hit_t(pixel);
  if (status == STATUS_HIT && old_kind != KIND_OUT_OF_STEPS && is_in_front) {
    let normal = vec3f(read_float_result(RESULT_NORMAL, id.x), read_float_result(RESULT_NORMAL + 1u, id.x),
      read_float_result(RESULT_NORMAL + 2u, id.x));
    let side = select(0u, 4u, dot(normal, direction) < 0.0);
    let color = min(surface.first_color + read_result(RESULT_COLOR, id.x), 2047u);
    write_hit(pixel, t, direction, normal, KIND_SURFACE | side | (color << 3u) | evaluations);
    return;
  }
  hits[8u * pixel + 7u] = (old_info & 0x3fffu) | evaluations;
}

// The fraction of the hemisphere over each point that is not hidden by other hits: `ambient_visibility`.
@compute @workgroup_size(64)
fn estimate_sky(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= uniforms.count) { return; }
  let pixel = uniforms.first + id.x;
  sky_visibility[pixel] = 1.0;
  if (!is_visible(pixel)) { return; }
  let direction = ray_direction(pixel);
  let normal = hit_normal_to_eye(pixel, direction);
  let pixel_size = hit_t(pixel) * uniforms.right.w * dot(direction, uniforms.forward.xyz);
  let reach = SKY_REACH * f32(max(uniforms.width, uniforms.height));
  let direction_count = uniforms.eye.w;
  var hidden = 0.0;
  for (var k = 0.0; k < direction_count; k += 1.0) {
    let angle = (k + uniforms.up.w) * (TWO_PI / direction_count);
    let horizon = horizon_height(
      pixel, normal, vec2f(cos(angle), sin(angle)), reach, reach * pixel_size);
    hidden += horizon * horizon;
  }
  sky_visibility[pixel] = 1.0 - hidden / direction_count;
}

// The sine of the elevation of the highest hit along a direction across the picture. reach: in
// pixels. radius: of the hits that count, on the stage.
fn horizon_height(pixel: u32, normal: vec3f, across: vec2f, reach: f32, radius: f32) -> f32 {
  let position = hit_position(pixel);
  let pixel_position = vec2f(f32(pixel % uniforms.width), f32(pixel / uniforms.width));
  let last_position = vec2f(f32(uniforms.width), f32(uniforms.height)) - 1.0;
  var horizon = 0.0;
  for (var k = 0u; k < SKY_SAMPLES; k++) {
    let fraction = (f32(k) + fract(5.0 * uniforms.up.w - 2.0)) / f32(SKY_SAMPLES);
    let sample_position = pixel_position + (1.0 + reach * fraction * fraction) * across;
    if (any(sample_position < vec2f(0.0)) || any(sample_position > last_position)) { continue; }
    let sample_pixel = u32(round(sample_position.y)) * uniforms.width + u32(round(sample_position.x));
    if (!is_visible(sample_pixel)) { continue; }
    let displacement = hit_position(sample_pixel) - position;
    let distance = max(length(displacement), 1e-12);
    let height = dot(displacement, normal) / distance - LEAST_SINE;
    if (height > 0.0) {
      let falloff = max(1.0 - (distance / radius) * (distance / radius), 0.0);
      horizon = max(horizon, height * falloff);
    }
  }
  return horizon;
}

// The radiance of a point in the studio's light: `StudioLight.shade`. eye: the unit vector to the camera.
// visible_sky, visible_key: the fractions of the sky and of the key light that reach the point.
fn shaded_color(
  color: vec3f, normal: vec3f, eye: vec3f, is_glossy: bool, visible_sky: f32, visible_key: f32,
) -> vec3f {
  let wrapped = clamp((dot(normal, uniforms.key.xyz) + KEY_WRAP) / (1.0 + KEY_WRAP), 0.0, 1.0);
  let key_fraction = (1.0 - KEY_HIDDEN * (1.0 - visible_sky)) * visible_key;
  let sky = mix(GROUND_IRRADIANCE, SKY_IRRADIANCE, 0.5 + 0.5 * dot(normal, uniforms.up.xyz)) * visible_sky;
  let radiance = color * (KEY_IRRADIANCE * (wrapped * key_fraction) + sky);
  if (!is_glossy) { return radiance; }
  let highlight = HIGHLIGHT
    * pow(max(dot(normal, normalize(uniforms.key.xyz + eye)), 0.0), HIGHLIGHT_EXPONENT);
  let rim = RIM * pow(1.0 - clamp(dot(normal, eye), 0.0, 1.0), 5.0);
  return radiance + KEY_IRRADIANCE * (highlight * wrapped * key_fraction) + sky * rim;
}

// The fractions of the key light and of the sky that reach a point of the floor, interpolated.
fn floor_light_at(position: vec3f) -> vec2f {
  let cell_position = (position.xy / (2.0 * FLOOR_HALF_WIDTH) + 0.5) * f32(FLOOR_CELLS) - 0.5;
  let low = floor(cell_position);
  let fraction = cell_position - low;
  var sum = vec2f(0.0);
  for (var k = 0u; k < 4u; k++) {
    let corner = vec2f(f32(k & 1u), f32(k >> 1u));
    let cell = vec2u(clamp(low + corner, vec2f(0.0), vec2f(f32(FLOOR_CELLS) - 1.0)));
    let weight = mix(1.0 - fraction, fraction, corner);
    sum += weight.x * weight.y * floor_light[cell.y * FLOOR_CELLS + cell.x];
  }
  return sum;
}

// A polynomial close to the color map of this name. VIRIDIS has its coefficients, the lowest degree
// first.
fn viridis(value: f32) -> vec3f {
  let x = clamp(value, 0.0, 1.0);
  var coefficients = VIRIDIS;
  var color = vec3f(0.0);
  for (var k = VIRIDIS_DEGREE; k >= 0; k--) { color = color * x + coefficients[k]; }
  return clamp(color, vec3f(0.0), vec3f(1.0));
}

// The color of a hit: the radiance in shaded pictures, sRGB in others. w: 0 where there is no hit.
fn hit_color(pixel: u32) -> vec4f {
  let info = hit_info(pixel);
  let kind = hit_kind(info);
  if (uniforms.mode == MODE_EVALUATIONS) {
    let x = (log2(f32(info >> 14u) + 1.0) - uniforms.scale.x) * uniforms.scale.y;
    return vec4f(select(viridis(x), OUT_OF_STEPS_COLOR, kind == KIND_OUT_OF_STEPS), 1.0);
  }
  if (kind == KIND_OUT_OF_STEPS) { return vec4f(OUT_OF_STEPS_COLOR, 1.0); }
  if (kind == KIND_NONE) { return vec4f(0.0); }
  if (uniforms.mode == MODE_NORMAL) { return vec4f(0.5 + 0.5 * hit_normal(pixel), 1.0); }
  if (uniforms.mode == MODE_STATUS) { return vec4f(HIT_COLOR, 1.0); }
  if (uniforms.mode == MODE_DEPTH) {
    let x = (hit_t(pixel) - uniforms.scale.x) * uniforms.scale.y;
    return vec4f(vec3f(mix(NEAR_GRAY, FAR_GRAY, clamp(x, 0.0, 1.0))), 1.0);
  }
  let direction = ray_direction(pixel);
  let normal = hit_normal_to_eye(pixel, direction);
  if (kind == KIND_GROUND) {
    let light = floor_light_at(hit_position(pixel));
    let visible_sky = min(sky_visibility[pixel], light.y);
    return vec4f(
      shaded_color(uniforms.ground.rgb, normal, -direction, false, visible_sky, light.x), 1.0);
  }
  let color_index = 2u * ((info >> 3u) & 2047u) + select(1u, 0u, (info & 4u) != 0u);
  let color = surface_colors[color_index];
  return vec4f(
    shaded_color(color.rgb, normal, -direction, color.w > 0.5, sky_visibility[pixel], 1.0), 1.0);
}

// Adds the colors of the hits to the mean of several pictures.
@compute @workgroup_size(64)
fn shade(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= uniforms.count) { return; }
  let pixel = uniforms.first + id.x;
  let color = hit_color(pixel);
  if (uniforms.weight > 0.999) { picture[pixel] = color; return; }
  picture[pixel] = mix(picture[pixel], color, uniforms.weight);
}

// Rays from the floor to the key light (kind 0) or to the sky (kind 1): `_visible_fractions`.
@compute @workgroup_size(64)
fn floor_rays(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= uniforms.count) { return; }
  let ray = uniforms.first + id.x;
  let cell = ray / RAYS_PER_CELL;
  let i = cell % FLOOR_CELLS; let j = cell / FLOOR_CELLS;
  let position = (vec2f(f32(i), f32(j)) + 0.5) / f32(FLOOR_CELLS) * 2.0 * FLOOR_HALF_WIDTH - FLOOR_HALF_WIDTH;
  let cell_of_block = (j % SAMPLE_BLOCK) * SAMPLE_BLOCK + i % SAMPLE_BLOCK;
  let direction_index = cell_of_block * RAYS_PER_CELL + ray % RAYS_PER_CELL;
  let direction_count = SAMPLE_BLOCK * SAMPLE_BLOCK * RAYS_PER_CELL;
  let direction = light_directions[uniforms.kind * direction_count + direction_index].xyz;
  write_lanes(id.x, vec3f(position, 0.0), direction, FLOOR_RAY_LENGTH);
}
@compute @workgroup_size(64)
fn merge_floor_hits(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= uniforms.count) { return; }
  if (read_result(RESULT_STATUS, id.x) != STATUS_MISS) {
    let ray_count = FLOOR_CELLS * FLOOR_CELLS * RAYS_PER_CELL;
    occluded[uniforms.kind * ray_count + uniforms.first + id.x] = 1u;
  }
}

// The picture on the canvas. Render passes only read these buffers.
@group(0) @binding(11) var<storage, read> displayed_picture: array<vec4f>;
@group(0) @binding(12) var<storage, read> displayed_hits: array<u32>;
@group(0) @binding(13) var<storage, read> marks: array<vec4f>;

// A triangle that covers the canvas.
@vertex
fn full_screen_vertex(@builtin(vertex_index) k: u32) -> @builtin(position) vec4f {
  return vec4f(f32(k & 1u) * 4.0 - 1.0, f32(k >> 1u) * 4.0 - 1.0, 0.0, 1.0);
}
fn to_srgb(color: vec3f) -> vec3f {
  let x = clamp(color, vec3f(0.0), vec3f(1.0));
  let power = (1.0 + SRGB_OFFSET) * pow(x, vec3f(1.0 / SRGB_GAMMA)) - SRGB_OFFSET;
  return select(power, SRGB_SLOPE * x, x <= vec3f(SRGB_LINEAR_END));
}
// Compresses highlights: radiance above SHOULDER_START approaches 1.
const SHOULDER_ROOM = 1.0 - SHOULDER_START;
fn compress_highlights(radiance: vec3f) -> vec3f {
  let compressed = 1.0 - SHOULDER_ROOM * exp((SHOULDER_START - radiance) / SHOULDER_ROOM);
  return select(radiance, compressed, radiance > vec3f(SHOULDER_START));
}
// The color of the picture at a position in pixels; interpolated along axes in which the picture has
// fewer pixels than the canvas.
fn picture_color(position: vec2f, size: vec2f) -> vec4f {
  let low = floor(position - 0.5);
  let is_fine = size >= uniforms.canvas_size;
  let fraction = select(position - 0.5 - low, vec2f(0.0), is_fine);
  var color = vec4f(0.0);
  for (var k = 0u; k < 4u; k++) {
    let corner = vec2f(f32(k & 1u), f32(k >> 1u));
    let weight = mix(1.0 - fraction, fraction, corner);
    if (weight.x * weight.y == 0.0) { continue; }
    let pixel = vec2u(clamp(low + corner + select(vec2f(0.0), vec2f(0.5), is_fine), vec2f(0.0), size - 1.0));
    color += weight.x * weight.y * displayed_picture[pixel.y * uniforms.width + pixel.x];
  }
  return color;
}
@fragment
fn display(@builtin(position) position: vec4f) -> @location(0) vec4f {
  let size = vec2f(f32(uniforms.width), f32(uniforms.height));
  let color = picture_color(position.xy / uniforms.canvas_size * size, size);
  if (uniforms.mode != MODE_SHADED) {
    return vec4f(color.rgb + (1.0 - color.a) * uniforms.background.rgb, 1.0);
  }
  let canvas_offset = position.xy - 0.5 * uniforms.canvas_size;
  let offset = canvas_offset * uniforms.right.w * size.x / uniforms.canvas_size.x;
  let direction = normalize(
    uniforms.forward.xyz + offset.x * uniforms.right.xyz - offset.y * uniforms.up.xyz);
  let upward = vec3f(0.0, 0.0, 1.0);
  let vignette = 1.0 - WALL_DARKENING * pow(clamp(direction.z, 0.0, 1.0), WALL_EXPONENT);
  let wall = shaded_color(uniforms.ground.rgb, upward, upward, false, 1.0, 1.0) * vignette;
  let radiance = compress_highlights(color.rgb / max(color.a, 1e-6));
  return vec4f(to_srgb(color.a * radiance + (1.0 - color.a) * wall), 1.0);
}

// Lines have two marks, dots have one. A mark is its position on the stage and its width in pixels.
// The buffer holds all marks, and after them their colors; `kind` is the number of marks.
struct MarkVertex {
  @builtin(position) position: vec4f,
  @location(0) color: vec4f,
  @location(1) stage_position: vec3f,
  @location(2) offset: vec2f,  // from the middle of the mark, whose edge is at 1
}
fn clip_position(position: vec3f) -> vec4f {
  let from_eye = position - uniforms.eye.xyz;
  let z = dot(from_eye, uniforms.forward.xyz);
  let half_size = 0.5 * uniforms.right.w * vec2f(f32(uniforms.width), f32(uniforms.height));
  return vec4f(dot(from_eye, uniforms.right.xyz) / half_size.x, dot(from_eye, uniforms.up.xyz) / half_size.y,
    0.5 * z, z);
}
@vertex
fn line_vertex(@builtin(vertex_index) k: u32) -> MarkVertex {
  let index = 2u * (k / 6u);
  // x: the start or the end of the line; y: the side of it.
  let corners = array<vec2f, 6>(vec2f(0, -1), vec2f(1, -1), vec2f(1, 1), vec2f(0, -1), vec2f(1, 1), vec2f(0, 1));
  let corner = corners[k % 6u];
  let start = clip_position(marks[index].xyz); let end = clip_position(marks[index + 1u].xyz);
  let along = (end.xy / end.w - start.xy / start.w) * uniforms.canvas_size;
  let across = vec2f(-along.y, along.x) / max(length(along), 1e-6);
  let middle = select(start, end, corner.x > 0.5);
  let mark = marks[index + u32(corner.x)];
  let position = middle.xy + corner.y * across * mark.w / uniforms.canvas_size * middle.w;
  return MarkVertex(vec4f(position, middle.zw), marks[index + uniforms.kind], mark.xyz, vec2f(0.0, corner.y));
}
@vertex
fn dot_vertex(@builtin(vertex_index) k: u32) -> MarkVertex {
  let index = k / 6u;
  let corners = array<vec2f, 6>(
    vec2f(-1, -1), vec2f(1, -1), vec2f(1, 1), vec2f(-1, -1), vec2f(1, 1), vec2f(-1, 1));
  let corner = corners[k % 6u];
  let middle = clip_position(marks[index].xyz);
  let position = middle.xy + corner * marks[index].w / uniforms.canvas_size * middle.w;
  return MarkVertex(vec4f(position, middle.zw), marks[index + uniforms.kind], marks[index].xyz, corner);
}
// The color of a mark: faint where a hit hides it.
@fragment
fn mark(vertex: MarkVertex) -> @location(0) vec4f {
  let size = vec2f(f32(uniforms.width), f32(uniforms.height));
  let pixel = vec2u(clamp(vertex.position.xy / uniforms.canvas_size * size, vec2f(0.0), size - 1.0));
  let t = bitcast<f32>(displayed_hits[8u * (pixel.y * uniforms.width + pixel.x) + 3u]);
  let is_hidden = distance(vertex.stage_position, uniforms.eye.xyz) > t * 1.003 + 0.004;
  let edge = 1.0 - smoothstep(0.75, 1.0, length(vertex.offset));
  return vec4f(vertex.color.rgb, vertex.color.a * edge * select(1.0, 0.12, is_hidden));
}
