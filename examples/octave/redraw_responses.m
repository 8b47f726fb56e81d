function worst = redraw_responses(folder, picture, matrices)
% Redraw measured and fitted responses from the files of scan2kd or dof2kd (Octave 7 or newer, MATLAB).
%
%   redraw_responses('results', 'responses.svg');
%   redraw_responses('results', 'responses.svg', 'models/kd.mat');
%
% Reads the motion from dof.h5 (MATLAB) or dof.csv (Octave has no h5read); K, D and M from kd.json and
% mass.json, or from the file of dof2kd --export mat. All about the footplate centre in footplate axes, SI,
% peak amplitudes, e^{+iwt}. Computes q_s = H q_b with H = (-w^2 M + i w D + K)^-1 (K + i w D).
% Returns the root mean square difference of the piston motion y, relative to its root mean square.
  if nargin < 3, matrices = ''; end
  [K, D, M, dof] = matrices_of(folder, matrices);
  if exist('h5read', 'file')
    [freq, stapes, base] = motion_of_h5(fullfile(folder, 'dof.h5'), dof);
  else
    [freq, stapes] = motion_of_csv(folder, 'stapes', dof);
    [~, base] = motion_of_csv(folder, 'base', dof);
  end
  fitted = zeros(size(stapes));
  for line = 1:numel(freq)
    w = 2 * pi * freq(line);
    Z = K + 1i * w * D;
    fitted(line, :) = ((Z - w^2 * M) \ (Z * base(line, :).')).';
  end
  y = find(strcmp(dof, 'y'));
  worst = sqrt(mean(abs(stapes(:, y) - fitted(:, y)).^2) / mean(abs(stapes(:, y)).^2));
  fprintf('y: measured and fitted differ by %.2f %%\n', 100 * worst);
  if nargin < 2 || isempty(picture), return; end
  figure('visible', 'off');
  for k = 1:numel(dof)
    subplot(1, numel(dof), k);
    semilogy(freq, abs(stapes(:, k)), '.', freq, abs(fitted(:, k)), '-');
    title(dof{k}); xlabel('frequency (Hz)');
  end
  [~, ~, kind] = fileparts(picture);
  print(picture, ['-d', kind(2:end)]);
end

function [K, D, M, dof] = matrices_of(folder, matrices)
% Stiffness, damping and mass matrix of the degrees of freedom of the fit.
  if ~isempty(matrices)
    fit = load(matrices);
    K = fit.K; D = fit.D; M = fit.M; dof = cellstr(fit.dof(:).');
    return
  end
  kd = jsondecode(fileread(fullfile(folder, 'kd.json')));
  mass = jsondecode(fileread(fullfile(folder, 'mass.json')));
  order = {'x', 'y', 'z', 'alpha', 'beta', 'gamma'};
  rows = cellfun(@(name) find(strcmp(order, name)), kd.dof);
  K = kd.stiffness_si; D = kd.damping_si; M = mass.mass_matrix.matrix_si(rows, rows); dof = kd.dof(:).';
end

function [freq, stapes, base] = motion_of_h5(file, dof)
% The motion of both bodies in dof.h5; MATLAB reverses dimensions: dof x line x body x run, fields r and i.
  q = h5read(file, '/q'); freq = h5read(file, '/freq_hz');
  bodies = cellstr(h5read(file, '/bodies')); names = cellstr(h5read(file, '/dof'));
  rows = cellfun(@(name) find(strcmp(names, name)), dof);
  pick = @(body) complex(q.r(rows, :, strcmp(bodies, body), 1), q.i(rows, :, strcmp(bodies, body), 1)).';
  stapes = pick('stapes'); base = pick('base');
end

function [freq, q] = motion_of_csv(folder, body, dof)
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
