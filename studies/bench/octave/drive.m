% Integrate the drive with ode23s of Octave: `octave drive.m problem.mat answer.mat`.
%
% problem.mat holds the vehicle constants and force tables, the road, and the solver options;
% answer.mat receives the states (N, 14) at the output times and the solver time [s].
% Strut forces act along the rows of B, tyre forces along those of G (principle of virtual work),
% so generalised forces are B' F.
1;

function F = curve(c, x_0, dx, x)
  u = (x - x_0) / dx;
  inside = min(max(u, 0), rows(c));
  i = min(floor(inside), rows(c) - 1);
  t = inside - i;
  c = c(i + 1, :);
  slope = c(:, 2) + t .* (2 * c(:, 3) + 3 * t .* c(:, 4));
  F = c(:, 1) + t .* (c(:, 2) + t .* (c(:, 3) + t .* c(:, 4))) + slope .* (u - inside);
end

function [z, slope] = road(p, s)
  u = min(max((s - p.start) / p.ds + p.pad, 1), columns(p.padded) - 3);
  i = floor(u);
  x = u - i;
  k = sub2ind(size(p.padded), p.side, i);
  n = rows(p.padded);
  a = p.padded(k); b = p.padded(k + n); c = p.padded(k + 2 * n); d = p.padded(k + 3 * n);
  p_1 = (c - a) / 2;
  p_2 = a - 2.5 * b + 2 * c - 0.5 * d;
  p_3 = (d - a) / 2 + 1.5 * (b - c);
  z = b + x .* (p_1 + x .* (p_2 + x .* p_3));
  slope = (p_1 + x .* (2 * p_2 + 3 * x .* p_3)) / p.ds;
end

function dy = rate(t, y, p)
  q = y(1:7); v = y(8:14);
  e = p.B * q; e_dot = p.B * v;
  column = p.x_1 + p.share .* e;
  inside = max(column, p.column_min);
  gas = p.p_A .* (p.x_1 ./ inside) .^ p.n_p;
  gas = gas .* (1 - p.n_p * (column - inside) ./ inside);
  stops = [curve(p.stops_front, p.E_0, p.dE, e(1:2)); curve(p.stops_rear, p.E_0, p.dE, e(3:4))];
  F = gas - curve(p.damper, p.V_0, p.dV, e_dot) - stops;
  [z, slope] = road(p, p.s_0 + p.v * t - p.behind);
  u = z - p.G * q; u_dot = p.v * slope - p.G * v;
  E = p.k_t .* max(p.delta + u, 0);
  T = max(min(E + p.c_t .* u_dot, 2 * E), 0);
  dy = [v; (p.B' * F + p.G' * T) ./ p.M - p.g];
end

p = load(argv(){1});
options = odeset("RelTol", p.rtol, "AbsTol", p.atol, "MaxStep", p.max_step);
tic;
[t, y] = ode23s(@(t, y) rate(t, y, p), p.t, p.y_0, options);
seconds = toc;
save("-v6", argv(){2}, "y", "seconds");
