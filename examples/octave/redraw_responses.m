function worst = redraw_responses(folder, picture)
% Redraw measured and fitted responses from the files of scan2kd (Octave 7 or newer, MATLAB).
%
%   redraw_responses('results', 'responses.png')
%
% Reads dof.csv (motion, m and rad, peak, e^{+iwt}), kd.json (K, D) and mass.json (M), all about the footplate
% centre in footplate axes, and computes q_s = H q_b with H = (-w^2 M + i w D + K)^-1 (K + i w D).
% Returns the root mean square difference of the piston motion y, relative to its root mean square.
  kd = jsondecode(fileread(fullfile(folder, 'kd.json')));
  mass = jsondecode(fileread(fullfile(folder, 'mass.json')));
  order = {'x', 'y', 'z', 'alpha', 'beta', 'gamma'};
  rows = cellfun(@(name) find(strcmp(order, name)), kd.dof);
  M = mass.mass_matrix.matrix_si(rows, rows);
  [freq, stapes] = motion_of(folder, 'stapes', kd.dof);
  [~, base] = motion_of(folder, 'base', kd.dof);
  fitted = zeros(size(stapes));
  for line = 1:numel(freq)
    w = 2 * pi * freq(line);
    Z = kd.stiffness_si + 1i * w * kd.damping_si;
    fitted(line, :) = ((Z - w^2 * M) \ (Z * base(line, :).')).';
  end
  y = find(strcmp(kd.dof, 'y'));
  worst = sqrt(mean(abs(stapes(:, y) - fitted(:, y)).^2) / mean(abs(stapes(:, y)).^2));
  fprintf('y: measured and fitted differ by %.2f %%\n', 100 * worst);
  if nargin < 2, return; end
  figure('visible', 'off');
  for k = 1:numel(kd.dof)
    subplot(1, numel(kd.dof), k);
    semilogy(freq, abs(stapes(:, k)), '.', freq, abs(fitted(:, k)), '-');
    title(kd.dof{k}); xlabel('frequency (Hz)');
  end
  print(picture, '-dpng');
end

function [freq, q] = motion_of(folder, body, dof)
% The lines of a body in dof.csv: frequencies (Hz), coordinates (lines x dof, complex).
  file = fopen(fullfile(folder, 'dof.csv'));
  header = strsplit(strtrim(fgetl(file)), ',');
  format = ['%s%s', repmat('%f', 1, numel(header) - 2)];
  cells = textscan(file, format, 'Delimiter', ',');
  fclose(file);
  column = @(name) cells{strcmp(header, name)};
  here = strcmp(column('body'), body);
  freq = column('freq_hz'); freq = freq(here);
  q = zeros(numel(freq), numel(dof));
  for k = 1:numel(dof)
    unit = 'rad';
    if any(strcmp(dof{k}, {'x', 'y', 'z'})), unit = 'm'; end
    part = @(which) column([dof{k}, '_', which, '_', unit]);
    real_part = part('re'); imaginary_part = part('im');
    q(:, k) = real_part(here) + 1i * imaginary_part(here);
  end
end
