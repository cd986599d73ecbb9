// What is done around a traced kernel: rays of the camera, what they met, the light of shaded
// pictures (harnack.rendering.shading), and lines and points in front.

struct View {
  eye: vec4f,         // on the stage; w: directions across the picture in which the sky is looked for
  right: vec4f,       // unit; w: of a pixel, at distance 1
  up: vec4f,          // unit; w: the rotation of these directions
  forward: vec4f,     // unit; w: where rays end
  key: vec4f,         // unit, to the key light; w: the height of the floor
  ground: vec4f,      // reflectance; w: 1 where there is a floor
  scale: vec4f,       // of numbers that are shown: low, 1 / (high - low)
  behind: vec4f,      // sRGB behind pictures of numbers
  canvas: vec2f, jitter: vec2f,
  width: u32, height: u32, first: u32, count: u32,
  weight: f32, show: u32, kind: u32, bands: u32,
}
struct Surface {
  lanes: array<vec4u, 2>,     // what the kernel's lanes are: see `value`
  results: array<vec4u, 2>,   // where its results are: see `result`
  number: u32,                // of its first paint
  lane_count: u32, pad_0: u32, pad_1: u32,
}
@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<uniform> surface: Surface;
@group(0) @binding(2) var<storage, read_write> lanes: array<f32>;
@group(0) @binding(3) var<storage, read> results: array<u32>;
@group(0) @binding(4) var<storage, read_write> hits: array<u32>;
@group(0) @binding(5) var<storage, read_write> sky_visibility: array<f32>;
@group(0) @binding(6) var<storage, read_write> picture: array<vec4f>;
@group(0) @binding(7) var<storage, read> colors: array<vec4f>;
@group(0) @binding(8) var<storage, read> floor_light: array<vec2f>;
@group(0) @binding(9) var<storage, read> light_directions: array<vec4f>;
@group(0) @binding(10) var<storage, read_write> occluded: array<u32>;

const NO_OUTPUT = 99u;
const NOTHING = 0u; const GROUND = 1u; const MET = 2u; const LOST = 3u;
const HIT = 1u; const OUT_OF_STEPS = 2u;
const SHADED = 0u; const NORMAL = 1u; const DEPTH = 2u; const EVALUATIONS = 3u; const STATUS = 4u;
const CELLS = 64u; const REACH = 2.4; const RAYS = 8u; const BLOCK = 4u; const FAR = 3.5;
const TAPS = 8u; const TAP_REACH = 0.16;
const NEVER = 3.0e38;

fn direction(pixel: u32) -> vec3f {
  let place = vec2f(f32(pixel % view.width), f32(pixel / view.width)) + view.jitter;
  let across = (place - 0.5 * vec2f(f32(view.width), f32(view.height))) * view.right.w;
  return normalize(view.forward.xyz + across.x * view.right.xyz - across.y * view.up.xyz);
}
fn write_lanes(id: u32, o: vec3f, d: vec3f, end: f32) {
  let values = array<f32, 7>(o.x, o.y, o.z, d.x, d.y, d.z, end);
  for (var k = 0u; k < surface.lane_count; k++) {
    lanes[k * view.count + id] = values[surface.lanes[k / 4u][k % 4u]];
  }
}
fn result(k: u32, id: u32) -> u32 {
  let place = surface.results[k / 4u][k % 4u];
  if (place == NO_OUTPUT) { return 0u; }
  return results[place * view.count + id];
}
fn number(k: u32, id: u32) -> f32 { return bitcast<f32>(result(k, id)); }

// Rays through pixels.
@compute @workgroup_size(64)
fn camera_rays(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= view.count) { return; }
  write_lanes(id.x, view.eye.xyz, direction(view.first + id.x), view.forward.w);
}

// Before any surface: the floor, or nothing.
@compute @workgroup_size(64)
fn clear_hits(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= view.count) { return; }
  let pixel = view.first + id.x;
  let d = direction(pixel);
  var t = NEVER;
  var kind = NOTHING;
  let far = (view.key.w - view.eye.z) / min(d.z, -1e-9);
  let there = view.eye.xyz + far * d;
  if (view.ground.w > 0.5 && view.show == SHADED && d.z < 0.0 && length(there.xy) < 100.0) {
    t = far; kind = GROUND;
  }
  write_hit(pixel, t, d, vec3f(0.0, 0.0, 1.0), kind);
}
fn write_hit(pixel: u32, t: f32, d: vec3f, normal: vec3f, info: u32) {
  let p = view.eye.xyz + t * d;
  let at = 8u * pixel;
  hits[at] = bitcast<u32>(p.x); hits[at + 1u] = bitcast<u32>(p.y);
  hits[at + 2u] = bitcast<u32>(p.z); hits[at + 3u] = bitcast<u32>(t);
  hits[at + 4u] = bitcast<u32>(normal.x); hits[at + 5u] = bitcast<u32>(normal.y);
  hits[at + 6u] = bitcast<u32>(normal.z); hits[at + 7u] = info;
}

// What rays have met of one surface: kept where it is nearer than what was met before. The word
// behind a pixel: what it is, whether the side of larger values is seen, its paint, evaluations.
@compute @workgroup_size(64)
fn merge_hits(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= view.count) { return; }
  let pixel = view.first + id.x;
  let before = hits[8u * pixel + 7u];
  let evaluations = min((before >> 14u) + result(5u, id.x), 0x3ffffu) << 14u;
  let status = result(0u, id.x);
  let d = direction(pixel);
  let t = number(1u, id.x);
  if (status == OUT_OF_STEPS) { write_hit(pixel, t, d, -d, LOST | evaluations); return; }
  // The floor stands below what was drawn at first: it hides nothing that has moved below it.
  let in_front = (before & 3u) == GROUND || t < bitcast<f32>(hits[8u * pixel + 3u]);
  if (status == HIT && (before & 3u) != LOST && in_front) {
    let n = vec3f(number(2u, id.x), number(3u, id.x), number(4u, id.x));
    let paint = min(surface.number + result(6u, id.x), 2047u);
    write_hit(pixel, t, d, n, MET | select(0u, 4u, dot(n, d) < 0.0) | (paint << 3u) | evaluations);
    return;
  }
  hits[8u * pixel + 7u] = (before & 0x3fffu) | evaluations;
}

fn position(pixel: u32) -> vec3f {
  let at = 8u * pixel;
  return vec3f(bitcast<f32>(hits[at]), bitcast<f32>(hits[at + 1u]), bitcast<f32>(hits[at + 2u]));
}
fn normal_to_eye(pixel: u32, d: vec3f) -> vec3f {
  let at = 8u * pixel;
  let n = vec3f(bitcast<f32>(hits[at + 4u]), bitcast<f32>(hits[at + 5u]), bitcast<f32>(hits[at + 6u]));
  return select(n, -n, dot(n, d) > 0.0);
}
fn is_there(pixel: u32) -> bool {
  let kind = hits[8u * pixel + 7u] & 3u;
  return kind == GROUND || kind == MET;
}

// The part of the hemisphere over each point that nothing in the picture hides: `visible_sky`.
@compute @workgroup_size(64)
fn estimate_sky(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= view.count) { return; }
  let pixel = view.first + id.x;
  sky_visibility[pixel] = 1.0;
  if (!is_there(pixel)) { return; }
  let d = direction(pixel);
  let p = position(pixel);
  let n = normal_to_eye(pixel, d);
  let t = bitcast<f32>(hits[8u * pixel + 3u]);
  let wide = t * view.right.w * dot(d, view.forward.xyz);
  let reach = TAP_REACH * f32(max(view.width, view.height));
  let radius = reach * wide;
  let x = f32(pixel % view.width); let y = f32(pixel / view.width);
  let directions = view.eye.w;
  var hidden = 0.0;
  for (var k = 0.0; k < directions; k += 1.0) {
    let angle = (k + view.up.w) * (6.2831853 / directions);
    let across = vec2f(cos(angle), sin(angle));
    var highest = 0.0;
    for (var tap = 0u; tap < TAPS; tap++) {
      let share = (f32(tap) + fract(5.0 * view.up.w - 2.0)) / f32(TAPS);
      let at = vec2f(x, y) + (1.0 + reach * share * share) * across;
      if (at.x < 0.0 || at.y < 0.0 || at.x > f32(view.width) - 1.0 || at.y > f32(view.height) - 1.0) {
        continue;
      }
      let other = u32(round(at.y)) * view.width + u32(round(at.x));
      if (!is_there(other)) { continue; }
      let toward = position(other) - p;
      let far = max(length(toward), 1e-12);
      let height = dot(toward, n) / far - 0.06;
      if (height > 0.0) { highest = max(highest, height * max(1.0 - (far / radius) * (far / radius), 0.0)); }
    }
    hidden += highest * highest;
  }
  sky_visibility[pixel] = 1.0 - hidden / directions;
}

const KEY = vec3f(0.74, 0.71, 0.66);
const ABOVE = vec3f(0.36, 0.40, 0.46);
const BELOW = vec3f(0.25, 0.225, 0.20);

// `Light.on`.
fn lit(color: vec3f, n: vec3f, eye: vec3f, is_glossy: bool, visible: f32, reached: f32) -> vec3f {
  let wrapped = clamp((dot(n, view.key.xyz) + 0.25) / 1.25, 0.0, 1.0);
  let shown = (1.0 - 0.6 * (1.0 - visible)) * reached;
  let above = mix(BELOW, ABOVE, 0.5 + 0.5 * dot(n, view.up.xyz)) * visible;
  let radiance = color * (KEY * (wrapped * shown) + above);
  if (!is_glossy) { return radiance; }
  let spot = 0.22 * pow(max(dot(n, normalize(view.key.xyz + eye)), 0.0), 60.0);
  let rim = 0.45 * pow(1.0 - clamp(dot(n, eye), 0.0, 1.0), 5.0);
  return radiance + KEY * (spot * wrapped * shown) + above * rim;
}

fn floor_at(p: vec3f) -> vec2f {
  let place = (p.xy / (2.0 * REACH) + 0.5) * f32(CELLS) - 0.5;
  let low = floor(place);
  let share = place - low;
  var sum = vec2f(0.0);
  for (var k = 0u; k < 4u; k++) {
    let step = vec2f(f32(k & 1u), f32(k >> 1u));
    let at = vec2u(clamp(low + step, vec2f(0.0), vec2f(f32(CELLS) - 1.0)));
    let part = mix(1.0 - share, share, step);
    sum += part.x * part.y * floor_light[at.y * CELLS + at.x];
  }
  return sum;
}

fn viridis(given: f32) -> vec3f {
  let x = clamp(given, 0.0, 1.0);
  var c = vec3f(-5.4321, 4.6416, 26.2721);
  c = c * x + vec3f(4.7518, -13.7494, -65.3210);
  c = c * x + vec3f(6.2037, 14.1540, 56.6563);
  c = c * x + vec3f(-4.5999, -5.7582, -19.2918);
  c = c * x + vec3f(-0.3272, 0.2148, 0.0920);
  c = c * x + vec3f(0.1077, 1.3965, 1.3868);
  return clamp(c * x + vec3f(0.2745, 0.0058, 0.3327), vec3f(0.0), vec3f(1.0));
}

// Light and covered part of shaded pictures; sRGB of others.
fn color_of(pixel: u32) -> vec4f {
  let d = direction(pixel);
  let info = hits[8u * pixel + 7u];
  let kind = info & 3u;
  let n = normal_to_eye(pixel, d);
  if (view.show == EVALUATIONS) {
    let x = (log2(f32(info >> 14u) + 1.0) - view.scale.x) * view.scale.y;
    return vec4f(select(viridis(x), vec3f(1.0, 0.0, 1.0), kind == LOST), 1.0);
  }
  if (kind == LOST) { return vec4f(1.0, 0.0, 1.0, 1.0); }
  if (kind == NOTHING) { return vec4f(0.0); }
  if (view.show == NORMAL) {
    let at = 8u * pixel + 4u;
    return vec4f(0.5 + 0.5 * vec3f(bitcast<f32>(hits[at]), bitcast<f32>(hits[at + 1u]),
      bitcast<f32>(hits[at + 2u])), 1.0);
  }
  if (view.show == STATUS) { return vec4f(0.93, 0.93, 0.90, 1.0); }
  if (view.show == DEPTH) {
    let x = (bitcast<f32>(hits[8u * pixel + 3u]) - view.scale.x) * view.scale.y;
    return vec4f(vec3f(mix(0.95, 0.12, clamp(x, 0.0, 1.0))), 1.0);
  }
  if (kind == GROUND) {
    let reached = floor_at(position(pixel));
    return vec4f(lit(view.ground.rgb, n, -d, false, min(sky_visibility[pixel], reached.y), reached.x), 1.0);
  }
  let color = colors[2u * ((info >> 3u) & 2047u) + select(1u, 0u, (info & 4u) != 0u)];
  return vec4f(lit(color.rgb, n, -d, color.w > 0.5, sky_visibility[pixel], 1.0), 1.0);
}

@compute @workgroup_size(64)
fn shade(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= view.count) { return; }
  let pixel = view.first + id.x;
  let color = color_of(pixel);
  if (view.weight > 0.999) { picture[pixel] = color; return; }
  picture[pixel] = mix(picture[pixel], color, view.weight);
}

// Rays from the floor to the key light (kind 0) or to the sky (kind 1): `floor._parts_seen`.
@compute @workgroup_size(64)
fn floor_rays(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= view.count) { return; }
  let ray = view.first + id.x;
  let cell = ray / RAYS;
  let i = cell % CELLS; let j = cell / CELLS;
  let place = (vec2f(f32(i), f32(j)) + 0.5) / f32(CELLS) * 2.0 * REACH - REACH;
  let number = ((j % BLOCK) * BLOCK + i % BLOCK) * RAYS + ray % RAYS;
  let d = light_directions[view.kind * BLOCK * BLOCK * RAYS + number].xyz;
  write_lanes(id.x, vec3f(place, 0.0), d, FAR);
}
@compute @workgroup_size(64)
fn merge_floor_hits(@builtin(global_invocation_id) id: vec3u) {
  if (id.x >= view.count) { return; }
  if (result(0u, id.x) != 0u) {
    occluded[view.kind * CELLS * CELLS * RAYS + view.first + id.x] = 1u;
  }
}

// The picture on the canvas.
@group(0) @binding(11) var<storage, read> shown: array<vec4f>;
@group(0) @binding(12) var<storage, read> drawn_hits: array<u32>;
@group(0) @binding(13) var<storage, read> marks: array<vec4f>;

@vertex
fn full_screen(@builtin(vertex_index) k: u32) -> @builtin(position) vec4f {
  return vec4f(f32(k & 1u) * 4.0 - 1.0, f32(k >> 1u) * 4.0 - 1.0, 0.0, 1.0);
}
fn to_srgb(x: vec3f) -> vec3f {
  let y = clamp(x, vec3f(0.0), vec3f(1.0));
  return select(1.055 * pow(y, vec3f(1.0 / 2.4)) - 0.055, 12.92 * y, y <= vec3f(0.0031308));
}
fn shouldered(x: vec3f) -> vec3f {
  return select(1.0 - 0.2 * exp(-(x - 0.8) / 0.2), x, x <= vec3f(0.8));
}
@fragment
fn display(@builtin(position) at: vec4f) -> @location(0) vec4f {
  let size = vec2f(f32(view.width), f32(view.height));
  let place = at.xy / view.canvas * size;
  let low = floor(place - 0.5);
  let share = select(place - 0.5 - low, vec2f(0.0), size >= view.canvas);
  var color = vec4f(0.0);
  for (var k = 0u; k < 4u; k++) {
    let step = vec2f(f32(k & 1u), f32(k >> 1u));
    let part = mix(1.0 - share, share, step);
    if (part.x * part.y == 0.0) { continue; }
    let p = vec2u(clamp(low + step + select(vec2f(0.0), vec2f(0.5), size >= view.canvas),
      vec2f(0.0), size - 1.0));
    color += part.x * part.y * shown[p.y * view.width + p.x];
  }
  if (view.show != SHADED) { return vec4f(color.rgb + (1.0 - color.a) * view.behind.rgb, 1.0); }
  let across = (at.xy - 0.5 * view.canvas) * view.right.w * size.x / view.canvas.x;
  let d = normalize(view.forward.xyz + across.x * view.right.xyz - across.y * view.up.xyz);
  let z = vec3f(0.0, 0.0, 1.0);
  let wall = lit(view.ground.rgb, z, z, false, 1.0, 1.0) * (1.0 - 0.45 * pow(clamp(d.z, 0.0, 1.0), 0.7));
  let light = shouldered(color.rgb / max(color.a, 1e-6));
  return vec4f(to_srgb(color.a * light + (1.0 - color.a) * wall), 1.0);
}

// Lines (pairs of marks) and dots (single ones). A mark: where, and how wide in pixels; after all
// marks come their colors.
struct Drawn {
  @builtin(position) at: vec4f,
  @location(0) color: vec4f,
  @location(1) there: vec3f,
  @location(2) across: vec2f,
}
fn on_canvas(p: vec3f) -> vec4f {
  let from_eye = p - view.eye.xyz;
  let z = dot(from_eye, view.forward.xyz);
  let wide = 0.5 * view.right.w * vec2f(f32(view.width), f32(view.height));
  return vec4f(dot(from_eye, view.right.xyz) / wide.x, dot(from_eye, view.up.xyz) / wide.y, 0.5 * z, z);
}
@vertex
fn line(@builtin(vertex_index) k: u32) -> Drawn {
  let one = 2u * (k / 6u);
  let corners = array<vec2f, 6>(vec2f(0, -1), vec2f(1, -1), vec2f(1, 1), vec2f(0, -1), vec2f(1, 1), vec2f(0, 1));
  let c = corners[k % 6u];
  let a = on_canvas(marks[one].xyz); let b = on_canvas(marks[one + 1u].xyz);
  let along_line = (b.xy / b.w - a.xy / a.w) * view.canvas;
  let side = vec2f(-along_line.y, along_line.x) / max(length(along_line), 1e-6);
  let here = select(a, b, c.x > 0.5);
  let end = marks[one + u32(c.x)];
  let moved = here.xy + c.y * side * end.w / view.canvas * here.w;
  return Drawn(vec4f(moved, here.zw), marks[one + view.kind], end.xyz, vec2f(0.0, c.y));
}
@vertex
fn dot_at(@builtin(vertex_index) k: u32) -> Drawn {
  let one = k / 6u;
  let corners = array<vec2f, 6>(vec2f(-1, -1), vec2f(1, -1), vec2f(1, 1), vec2f(-1, -1), vec2f(1, 1), vec2f(-1, 1));
  let c = corners[k % 6u];
  let here = on_canvas(marks[one].xyz);
  let moved = here.xy + c * marks[one].w / view.canvas * here.w;
  return Drawn(vec4f(moved, here.zw), marks[one + view.kind], marks[one].xyz, c);
}
@fragment
fn mark(drawn: Drawn) -> @location(0) vec4f {
  let far = length(drawn.across);
  let size = vec2f(f32(view.width), f32(view.height));
  let p = vec2u(clamp(drawn.at.xy / view.canvas * size, vec2f(0.0), size - 1.0));
  let before = bitcast<f32>(drawn_hits[8u * (p.y * view.width + p.x) + 3u]);
  let hidden = distance(drawn.there, view.eye.xyz) > before * 1.003 + 0.004;
  let edge = 1.0 - smoothstep(0.75, 1.0, far);
  return vec4f(drawn.color.rgb, drawn.color.a * edge * select(1.0, 0.12, hidden));
}
